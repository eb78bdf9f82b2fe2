"""Whether a checkpoint is of the run that is to go on from it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from logvggt_jax.errors import InputError
from logvggt_jax.training.checkpoints.checkpoint_files import StoredCheckpoint
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.setting_differences import (
    differences,
    first_of,
    what_decides_clips,
    what_decides_labels,
)


def check_configuration(stored: StoredCheckpoint, config: TrainConfig) -> None:
    """Raises InputError naming the settings, of those that decide what is learned, in which they differ.

    A finished run may be given further stages, or more steps of its last one.
    """
    ours, written = config.to_dict(), stored.config
    with contextlib.suppress(InputError):  # with what an earlier version had no field for
        # Validation may change, and is not to keep the rest from being read where its fields did.
        written = TrainConfig.from_dict({**written, "validation": None}).to_dict()
    found: list[str] = []
    for part in ("model", "stages", "data", "loss", "optimizer", "seed", "average", "teacher"):
        then, now = written.get(part), ours[part]
        if part == "stages" and then is not None and _goes_further(stored.step, then, now):
            continue
        if part == "data" and then is not None:
            then, now = what_decides_clips(then), what_decides_clips(now)
        if part == "teacher":
            then, now = what_decides_labels(then), what_decides_labels(now)
        found += [f"{name}={theirs!r}, now {mine!r}" for name, theirs, mine in differences(then, now, part)]
    if found:
        mend = "Set them back"
        if any(each.startswith("stages") for each in found):
            mend += " (a finished run may get stages after its last one, or else more steps of that one)"
        raise InputError(
            f"{stored.where} was written with other settings: {first_of(found)}. {mend}, or start a "
            "new --workdir, which --config.initial_weights lets begin with the model of this one"
        )


def _goes_further(done: int, then: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the stages `now` are those of `then`, all finished after `done` steps, and more of them.

    Either stages that follow, or steps of the last one: with another number of stages that one draws other clips.
    """
    if done != sum(stage["steps"] for stage in then):
        return False
    if len(now) > len(then):
        return list(now[: len(then)]) == list(then)
    *before, last = then
    return list(now) == [*before, {**last, "steps": now[-1]["steps"]}] and now[-1]["steps"] > last["steps"]
