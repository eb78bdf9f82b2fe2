"""Data sets by name."""

import inspect
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from logvggt_jax.config import typed
from logvggt_jax.data.dataset import Reader
from logvggt_jax.data.packed.index import is_packed
from logvggt_jax.data.readers.arkitscenes import ARKitScenes
from logvggt_jax.data.readers.blendedmvs import BlendedMVS
from logvggt_jax.data.readers.bonn import Bonn
from logvggt_jax.data.readers.co3dv2 import Co3Dv2
from logvggt_jax.data.readers.colmap import Colmap
from logvggt_jax.data.readers.hypersim import HyperSim
from logvggt_jax.data.readers.images import Images
from logvggt_jax.data.readers.kitti import KITTI
from logvggt_jax.data.readers.kitti_odometry import KITTIOdometry
from logvggt_jax.data.readers.mvs_synth import MVSSynth
from logvggt_jax.data.readers.nerfstudio import Nerfstudio
from logvggt_jax.data.readers.nrgbd import NRGBD
from logvggt_jax.data.readers.pointodyssey import PointOdyssey
from logvggt_jax.data.readers.replica import Replica
from logvggt_jax.data.readers.scannet import ScanNet
from logvggt_jax.data.readers.seven_scenes import SevenScenes
from logvggt_jax.data.readers.sintel import Sintel
from logvggt_jax.data.readers.spring import Spring
from logvggt_jax.data.readers.tum import TUM
from logvggt_jax.data.readers.tum_recording import TUMRecording
from logvggt_jax.data.readers.virtual_kitti import VirtualKITTI
from logvggt_jax.data.readers.wildrgbd import WildRGBD
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError

_READERS: tuple[type[Reader], ...] = (
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
    SevenScenes,
    NRGBD,
    Sintel,
    Bonn,
    KITTI,
    TUM,
    Rooms,
    KITTIOdometry,
    TUMRecording,
    Colmap,
    Nerfstudio,
    Images,
)
READERS: dict[str, type[Reader]] = {reader.name: reader for reader in _READERS}
"""Readers by name: the paper's training sets, those that it only evaluates on, rooms, those that it does not use."""

DATASETS: tuple[str, ...] = tuple(READERS)
"""All names that `open_dataset` knows."""


def open_dataset(name: str, root: str | Path | None, split: str = "all", **options: Any) -> Reader:
    """Opens data set `name` (one of `DATASETS`) in folder `root`.

    Args:
      name: for example `seven_scenes`.
      root: the data set's folder, or one that `logvggt data pack` made of it; None for `rooms`, which are procedural.
      split: `train`, `val`, `test` or `all`, of those the set has; `all` needs no list file.
      **options: further arguments of the set's reader; `rooms` has several, `arkitscenes` one.

    Raises:
      InputError: unknown name or option, a split that the set does not have, or a wrong `root`.
      MissingFiles: the folder or a file in it is missing; named.
    """
    options = checked_options(name, options)
    reader = READERS[name]
    if root is not None and is_packed(root):
        # Grain, which reads shards, takes a second to load.
        from logvggt_jax.data.packed.dataset import open_packed

        return open_packed(root, split, reader, options)
    make: Any = reader
    if not reader.needs_root:
        if root is not None:
            raise InputError(f"{name} are made when they are read and have no folder, got root={root}: pass root=None")
        return make(split=split, **options)
    if root is None:
        raise InputError(f"{name} needs root, the folder that holds {reader.expects}")
    return make(root=root, split=split, **options)


def checked_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a data set's reader, each as the type that the reader has for it.

    Raises InputError for an unknown data set, for names of options that its reader does not have, and for values of
    another type.
    """
    types = option_types(name)
    for option in options:
        if option not in types:
            others = [other for other in READERS if option in option_types(other)]
            of = f", and {option} is one of {', '.join(others)}: take a configuration of {name}" if others else ""
            raise InputError(f"{name}: unknown option {option!r}; known are {', '.join(types) or 'none'}{of}")
    return {option: typed(types[option], value, f"{name}: {option}") for option, value in options.items()}


def option_types(name: str) -> dict[str, Any]:
    """Types of the options of a data set's reader, by their names; InputError for an unknown data set."""
    if name not in READERS:
        raise InputError(f"unknown data set {name!r}: choose one of {', '.join(DATASETS)}")
    hints = typing.get_type_hints(READERS[name].__init__)
    parameters = inspect.signature(READERS[name]).parameters
    return {option: hints[option] for option in parameters if option not in ("root", "split")}
