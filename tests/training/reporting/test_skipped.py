"""Clips of updates that were left out are named alike by all processes, whoever has them."""

import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from logvggt_jax.training.parallel import agreement
from logvggt_jax.training.reporting.skipped import clips_to_blame

OTHERS = (json.dumps([["d"], ["c", "d"]]), json.dumps([[], ["e"]]))


@pytest.mark.parametrize(
    ("finite", "others", "blamed", "which"),
    [
        ([True, False], OTHERS, ["b", "d"], "in"),
        ([True, True], OTHERS, ["d"], "in"),
        ([True, True], OTHERS[1:], ["a", "b", "e"], "with all or some of"),
        (
            [True, True],
            (None, OTHERS[1]),
            ["a", "b", "e"],
            "with all or some of (those of the processes [1] are not known)",
        ),
        (
            [False, True],
            (OTHERS[1], None),
            ["a"],
            "in (those of the processes [2] are not known)",
        ),
    ],
)
def test_a_process_blames_what_all_have_found(
    finite: list[bool], others: tuple[str | None, ...], blamed: list[str], which: str
) -> None:
    assert clips_to_blame(np.array(finite), ["a", "b"], lambda own: [own, *others]) == (blamed, which)


def test_one_silent_process_leaves_the_others_time_to_be_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    from jax._src import distributed

    texts: dict[str, str] = {}
    waits = []

    def get(key: str, milliseconds: int) -> str:
        waits.append(milliseconds)
        if key.endswith("/1"):
            raise jax.errors.JaxRuntimeError("DEADLINE_EXCEEDED")
        return key

    client = SimpleNamespace(
        key_value_set=texts.__setitem__, blocking_key_value_get=get, key_value_delete=texts.__delitem__
    )
    monkeypatch.setattr(distributed, "global_state", SimpleNamespace(client=client))
    monkeypatch.setattr(agreement, "ANSWER_SECONDS", 0.0)
    monkeypatch.setattr(jax, "process_count", lambda: 4)
    monkeypatch.setattr(jax, "process_index", lambda: 2)
    exchange = agreement.Exchange("clips")
    assert exchange(7, "own") == ["logvggt/clips/7/0", None, "own", "logvggt/clips/7/3"]
    assert len(waits) == 3 and min(waits) >= 1000
    exchange(8, "later")
    assert texts == {"logvggt/clips/8/2": "later"}
