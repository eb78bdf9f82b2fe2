"""Data sets by name."""

from __future__ import annotations

from pathlib import Path

from logvggt_jax.data.dataset import Dataset, check_split
from logvggt_jax.data.readers.arkitscenes import ARKitScenes
from logvggt_jax.data.readers.blendedmvs import BlendedMVS
from logvggt_jax.data.readers.bonn import Bonn
from logvggt_jax.data.readers.co3dv2 import Co3Dv2
from logvggt_jax.data.readers.folder_dataset import FolderDataset
from logvggt_jax.data.readers.hypersim import HyperSim
from logvggt_jax.data.readers.kitti import KITTI
from logvggt_jax.data.readers.mvs_synth import MVSSynth
from logvggt_jax.data.readers.nrgbd import NRGBD
from logvggt_jax.data.readers.pointodyssey import PointOdyssey
from logvggt_jax.data.readers.replica import Replica
from logvggt_jax.data.readers.scannet import ScanNet
from logvggt_jax.data.readers.seven_scenes import SevenScenes
from logvggt_jax.data.readers.sintel import Sintel
from logvggt_jax.data.readers.spring import Spring
from logvggt_jax.data.readers.tum import TUM
from logvggt_jax.data.readers.virtual_kitti import VirtualKITTI
from logvggt_jax.data.readers.wildrgbd import WildRGBD
from logvggt_jax.data.rooms.rooms import Rooms

_FOR_TRAINING: tuple[type[FolderDataset], ...] = (
    Co3Dv2,
    BlendedMVS,
    ARKitScenes,
    WildRGBD,
    ScanNet,
    MVSSynth,
    PointOdyssey,
    VirtualKITTI,
    Spring,
    HyperSim,
    Replica,
)
_FOR_EVALUATION: tuple[type[FolderDataset], ...] = (SevenScenes, NRGBD, Sintel, Bonn, KITTI, TUM)
READERS: dict[str, type[FolderDataset]] = {reader.name: reader for reader in (*_FOR_TRAINING, *_FOR_EVALUATION)}
"""Readers of the sets on disk, by name; the paper's training sets first."""

DATASETS: tuple[str, ...] = (*READERS, "rooms")
"""All names that `open_dataset` knows."""


def open_dataset(name: str, root: str | Path | None, split: str = "all") -> Dataset:
    """Opens data set `name` (one of `DATASETS`) in folder `root`.

    Args:
      name: for example `seven_scenes`.
      root: the data set's folder; None for `rooms`, which are procedural.
      split: `train`, `val`, `test` or `all`, of those the set has; `all` needs no list file.

    Raises:
      ValueError: unknown name, a split that the set does not have, or a wrong `root`.
      FileNotFoundError: the folder or a file in it is missing; named.
    """
    check_split(split)
    if name == "rooms":
        if root is not None:
            raise ValueError(f"rooms are procedural and have no folder, got root={root}: pass root=None")
        return Rooms(split)
    if name not in READERS:
        raise ValueError(f"unknown data set {name!r}: choose one of {', '.join(DATASETS)}")
    reader = READERS[name]
    if root is None:
        raise ValueError(f"{name} needs root, the folder that holds {reader.expects}")
    return reader(root, split)
