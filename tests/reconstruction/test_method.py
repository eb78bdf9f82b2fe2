"""The method follows from what the weights were trained for; another choice is a warning that says why."""

from __future__ import annotations

import warnings

import pytest

from logvggt_jax.reconstruction.method import choose_method
from logvggt_jax.streaming import METHODS
from logvggt_jax.weights.provenance import Provenance


@pytest.mark.parametrize(
    ("trained_for", "asked", "method"),
    [
        ("windows", None, "windows"),
        ("windows", "windows", "windows"),
        ("vggt", None, "chunks"),
        ("vggt", "chunks", "chunks"),
        ("vggt", "offline", "offline"),
        ("causal", None, "causal"),
        ("causal", "rolling", "rolling"),
        ("causal", "anchored-window", "anchored-window"),
        (None, "windows", "windows"),
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
        ("windows", "offline", "offline", "offline shows them more frames at once"),
        ("vggt", "causal", "causal", "causal shows a frame earlier ones alone.*leave --method out for chunks"),
        ("windows", "rolling", "rolling", "rolling gives all layers a memory.*leave --method out for windows"),
        ("causal", "windows", "windows", "never learned to pass the first camera on.*leave --method out for causal"),
        ("causal", "offline", "offline", "offline shows them later ones as well"),
        (None, None, "windows", "does not say what its weights were trained for"),
    ],
)
def test_another_use_is_a_warning_that_says_why(
    trained_for: str | None, asked: str | None, method: str, why: str
) -> None:
    with pytest.warns(UserWarning, match=why):
        assert choose_method(Provenance(trained_for), asked) == method


def test_whatever_the_weights_there_is_at_most_one_warning() -> None:
    for trained_for in ("windows", "vggt", "causal", None):
        for method in METHODS:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                choose_method(Provenance(trained_for), method)  # type: ignore[arg-type]
            suits = trained_for in (None, METHODS[method].trained_for)
            assert len(caught) == (0 if suits else 1), (trained_for, method)
