"""The method follows from what the weights were trained for; another choice is a warning that says why."""

from __future__ import annotations

import warnings

import pytest

from logvggt_jax.reconstruction.method import choose_method
from logvggt_jax.weights.provenance import Provenance


@pytest.mark.parametrize(
    ("trained_for", "asked", "method"),
    [
        ("windows", None, "windows"),
        ("windows", "windows", "windows"),
        ("vggt", None, "chunks"),
        ("vggt", "chunks", "chunks"),
    ],
)
def test_weights_are_used_as_they_were_trained(trained_for: str, asked: str | None, method: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_method(Provenance(trained_for), asked) == method


@pytest.mark.parametrize(
    ("trained_for", "asked", "method", "why"),
    [
        ("vggt", "windows", "windows", "never learned to pass the first camera on"),
        ("windows", "chunks", "chunks", "chunks shows them more frames at once"),
        (None, None, "windows", "does not say what its weights were trained for"),
    ],
)
def test_another_use_is_a_warning_that_says_why(
    trained_for: str | None, asked: str | None, method: str, why: str
) -> None:
    with pytest.warns(UserWarning, match=why):
        assert choose_method(Provenance(trained_for), asked) == method
