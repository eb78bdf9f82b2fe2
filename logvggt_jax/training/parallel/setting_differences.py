"""In which settings two runs differ, or two processes of one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# How fast, from where and with how many broken clips the data come; the data stream checks that they are the same.
_FREE_DATA_SETTINGS = ("worker_count", "num_threads", "cache_dir", "max_broken")
# Where the teacher lies, which the data stream knows by its digest, and whether validation asks it.
_FREE_TEACHER_SETTINGS = ("weights", "validation")
_SHOWN = 5


def what_decides_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """The data settings without those that a run may change when it goes on: its clips stay the same."""
    kept = {name: value for name, value in data.items() if name not in _FREE_DATA_SETTINGS}
    kept["sources"] = [
        {**{name: value for name, value in source.items() if name != "root"}, "options": dict(source["options"])}
        for source in data["sources"]
    ]
    return kept


def what_decides_labels(teacher: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The teacher's settings without those that a run may change when it goes on: its labels stay the same."""
    if teacher is None:
        return None
    return {name: value for name, value in teacher.items() if name not in _FREE_TEACHER_SETTINGS}


def differences(theirs: Any, ours: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """The names of the leaves in which trees of JSON types differ, and both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted(theirs.keys() | ours.keys()):
            yield from differences(theirs.get(key), ours.get(key), f"{name}.{key}")
    elif isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        for i, (a, b) in enumerate(zip(theirs, ours, strict=True)):
            yield from differences(a, b, f"{name}[{i}]")
    elif theirs != ours:
        yield name, _named(theirs), _named(ours)


def _named(value: Any) -> Any:
    """The names of stages or sources, of which there are others or not as many; other values as they are."""
    if isinstance(value, list) and value and all(isinstance(each, dict) and "name" in each for each in value):
        return [each["name"] for each in value]
    return value


def first_of(found: Sequence[str]) -> str:
    """Differences in words, the first of many."""
    more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return "; ".join(found[:_SHOWN]) + more
