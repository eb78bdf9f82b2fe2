"""Whether a checkpoint is of the run that is to go on from it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

from logvggt_jax.errors import InputError
from logvggt_jax.training.checkpoints.checkpoint_files import StoredCheckpoint
from logvggt_jax.training.config import TrainConfig

# How fast, from where and with how many broken clips the data come; the data stream checks that they are the same.
_FREE_DATA_SETTINGS = ("worker_count", "num_threads", "cache_dir", "max_broken")


def check_configuration(stored: StoredCheckpoint, config: TrainConfig) -> None:
    """Raises InputError naming the first setting, of those that decide what is learned, in which they differ."""
    ours, written = config.to_dict(), stored.config
    with contextlib.suppress(InputError):  # with what an earlier version had no field for
        # Validation may change, and is not to keep the rest from being read where its fields did.
        written = TrainConfig.from_dict({**written, "validation": None}).to_dict()
    for part in ("model", "stages", "data", "loss", "optimizer", "seed", "average"):
        then, now = written.get(part), ours[part]
        if part == "data" and then is not None:
            then, now = _what_decides_clips(then), _what_decides_clips(now)
        difference = _first_difference(then, now, part)
        if difference is not None:
            name, theirs, mine = difference
            raise InputError(
                f"{stored.where} was written with {name}={theirs!r}, the configuration says {mine!r}; "
                "set it back or start a new --workdir"
            )


def _what_decides_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """The data settings without those that a run may change when it goes on: its clips stay the same."""
    kept = {name: value for name, value in data.items() if name not in _FREE_DATA_SETTINGS}
    kept["sources"] = [{name: value for name, value in source.items() if name != "root"} for source in data["sources"]]
    return kept


def _first_difference(theirs: Any, ours: Any, name: str) -> tuple[str, Any, Any] | None:
    """The name of the first leaf in which trees of JSON types differ, and both values."""
    pairs: list[tuple[Any, Any, str]] = []
    if isinstance(theirs, dict) and isinstance(ours, dict):
        pairs = [(theirs.get(key), ours.get(key), f"{name}.{key}") for key in sorted(theirs.keys() | ours.keys())]
    elif isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        pairs = [(a, b, f"{name}[{i}]") for i, (a, b) in enumerate(zip(theirs, ours, strict=True))]
    elif theirs != ours:
        return name, theirs, ours
    return next((found for pair in pairs if (found := _first_difference(*pair)) is not None), None)
