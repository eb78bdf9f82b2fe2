"""Data sets as evaluation opens them: rooms at the model's size, everything else from disk."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.registry import open_dataset
from logvggt_jax.data.rooms import Rooms


def open_evaluation_set(
    name: str,
    root: str | None,
    *,
    split: str,
    image_size: tuple[int, int],
    rooms: Mapping[str, Any] | None = None,
) -> tuple[Dataset, Dataset, str]:
    """The data set to evaluate, and the one whose mean depth the baselines know, with its name for the table.

    Args:
      name: one of `logvggt_jax.data.DATASETS`.
      root: its folder; None for `rooms`.
      split: `train`, `val`, `test` or `all`.
      image_size: (H, W); rooms are rendered at this size, as they are for training.
      rooms: further options of `logvggt_jax.data.rooms.Rooms`, for `rooms` alone.

    Returns:
      Rooms are paired with their training split. Any other set has to lend its own mean, and the name says so.

    Raises:
      ValueError: `root` is missing, or given for `rooms`; an unknown option of rooms.
      FileNotFoundError: `root` does not hold the data set.
    """
    if name != "rooms":
        if root is None:
            raise ValueError(f"data set {name!r} is read from disk: give its folder with --data_root")
        dataset = open_dataset(name, root, split)
        return dataset, dataset, "frames of the evaluated set itself (knows the test set's mean)"
    if root is not None:
        raise ValueError(f"rooms are rendered, not read: leave --data_root={root} out")
    height, width = image_size
    options = dict(rooms or {})
    known = inspect.signature(Rooms).parameters
    for option in options:
        if option not in known or option in ("split", "height", "width"):
            raise ValueError(f"rooms: unknown option {option!r}; known are {', '.join(known)} without split and size")
    train = {key: value for key, value in options.items() if key != "num_rooms"}
    return (
        Rooms(split=split, height=height, width=width, **options),
        Rooms(split="train", height=height, width=width, **train),
        "training rooms",
    )
