"""Whether a checkpoint is of the run that is to go on from it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from logvggt_jax.errors import InputError
from logvggt_jax.training.checkpoints.checkpoint_files import StoredCheckpoint
from logvggt_jax.training.config import TrainConfig

_NAMED = 5
# How fast, from where and with how many broken clips the data come; the data stream checks that they are the same.
_FREE_DATA_SETTINGS = ("worker_count", "num_threads", "cache_dir", "max_broken")
# Where the teacher lies, which the data stream knows by its digest, and whether validation asks it.
_FREE_TEACHER_SETTINGS = ("weights", "validation")


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
            then, now = _what_decides_clips(then), _what_decides_clips(now)
        if part == "teacher":
            then, now = _what_decides_labels(then), _what_decides_labels(now)
        found += [f"{name}={theirs!r}, now {mine!r}" for name, theirs, mine in _differences(then, now, part)]
    if found:
        more = f"; and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        mend = "Set them back"
        if any(each.startswith("stages") for each in found):
            mend += " (a finished run may get stages after its last one, or else more steps of that one)"
        raise InputError(
            f"{stored.where} was written with other settings: {'; '.join(found[:_NAMED])}{more}. {mend}, or start a "
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


def _what_decides_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """The data settings without those that a run may change when it goes on: its clips stay the same."""
    kept = {name: value for name, value in data.items() if name not in _FREE_DATA_SETTINGS}
    kept["sources"] = [{name: value for name, value in source.items() if name != "root"} for source in data["sources"]]
    return kept


def _what_decides_labels(teacher: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The teacher's settings without those that a run may change when it goes on: its labels stay the same."""
    if teacher is None:
        return None
    return {name: value for name, value in teacher.items() if name not in _FREE_TEACHER_SETTINGS}


def _differences(theirs: Any, ours: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """The names of the leaves in which trees of JSON types differ, and both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted(theirs.keys() | ours.keys()):
            yield from _differences(theirs.get(key), ours.get(key), f"{name}.{key}")
    elif isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        for i, (a, b) in enumerate(zip(theirs, ours, strict=True)):
            yield from _differences(a, b, f"{name}[{i}]")
    elif theirs != ours:
        yield name, _named(theirs), _named(ours)


def _named(value: Any) -> Any:
    """The names of stages or sources, of which there are others or not as many; other values as they are."""
    if isinstance(value, list) and value and all(isinstance(each, dict) and "name" in each for each in value):
        return [each["name"] for each in value]
    return value
