"""Clips of updates that were left out are named alike by all processes, whoever has them."""

import json

import jax.numpy as jnp
import pytest

from logvggt_jax.training.reporting.skipped import clips_to_blame

OTHERS = (json.dumps([["d"], ["c", "d"]]), json.dumps([[], ["e"]]))


@pytest.mark.parametrize(
    ("finite", "others", "blamed", "reason"),
    [
        ([True, False], OTHERS, ["b", "d"], "loss was not finite in"),
        ([True, True], OTHERS, ["d"], "loss was not finite in"),
        ([True, True], OTHERS[1:], ["a", "b", "e"], "loss or gradient was not finite, with all or some of"),
        (
            [True, True],
            (None, OTHERS[1]),
            ["a", "b", "e"],
            "loss or gradient was not finite, with all or some of (those of the processes [1] are not known)",
        ),
        (
            [False, True],
            (OTHERS[1], None),
            ["a"],
            "loss was not finite in (those of the processes [2] are not known)",
        ),
    ],
)
def test_a_process_blames_what_all_have_found(
    finite: list[bool], others: tuple[str | None, ...], blamed: list[str], reason: str
) -> None:
    assert clips_to_blame(jnp.array(finite), ["a", "b"], lambda own: [own, *others]) == (blamed, reason)
