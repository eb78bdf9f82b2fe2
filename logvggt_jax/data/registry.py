"""Data sets by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from logvggt_jax.data.dataset import Dataset, check_split
from logvggt_jax.data.rooms import Rooms
from logvggt_jax.data.seven_scenes import SevenScenes

DATASETS = (
    "co3dv2",
    "blendedmvs",
    "arkitscenes",
    "wildrgbd",
    "scannet",
    "mvs_synth",
    "pointodyssey",
    "virtual_kitti",
    "spring",
    "hypersim",
    "replica",
    "seven_scenes",
    "nrgbd",
    "sintel",
    "bonn",
    "kitti",
    "tum",
    "rooms",
)


def _open_rooms(root: str | Path | None, split: str) -> Dataset:
    if root is not None:
        raise ValueError(f"rooms are procedural and have no folder, got root={root}: pass root=None")
    return Rooms(split)


def _open_seven_scenes(root: str | Path | None, split: str) -> Dataset:
    if root is None:
        raise ValueError("seven_scenes needs root, the folder that holds the scenes")
    return SevenScenes(root, split)


_READERS: dict[str, Callable[[str | Path | None, str], Dataset]] = {
    "rooms": _open_rooms,
    "seven_scenes": _open_seven_scenes,
}


def open_dataset(name: str, root: str | Path | None, split: str = "all") -> Dataset:
    """Opens data set `name` (one of `DATASETS`) in folder `root`.

    Args:
      name: for example `seven_scenes`.
      root: the data set's folder; None for `rooms`, which are procedural.
      split: `train`, `val`, `test` or `all`; `all` needs no list file.

    Raises:
      ValueError: unknown name or split, a name without a reader in this version, or a wrong `root`.
      FileNotFoundError: the folder or a file in it is missing; named.
    """
    check_split(split)
    if name not in DATASETS:
        raise ValueError(f"unknown data set {name!r}: choose one of {', '.join(DATASETS)}")
    if name not in _READERS:
        raise ValueError(f"this version has no reader for {name!r}; it reads {', '.join(sorted(_READERS))}")
    return _READERS[name](root, split)
