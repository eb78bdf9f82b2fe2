"""Procedural rooms as a data set: images, exact depth and poses of rooms that exist only as a seed."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.dataset import (
    EVALUATION,
    TRAINING,
    About,
    Dataset,
    Reader,
    check_indices,
    check_sequence,
    check_split,
)
from logvggt_jax.data.rooms.layout import STYLES, Room, random_room
from logvggt_jax.data.rooms.pool import render_pool
from logvggt_jax.data.rooms.ray_caster import render
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames

_RENDERER_VERSION = 1  # raise it whenever the same options give other frames
_DEFAULT_ROOMS = {"train": 1500, "val": 32, "test": 32}


class Rooms(Reader):
    """Furnished box rooms seen along smooth closed camera paths, rendered when read.

    A room is a function of (`seed`, `style`, its number) and each of its frames one of the options and the
    frame's index alone: the same options give the same bytes in any order and process. Numbers ending in 8 are
    validation rooms, in 9 test rooms, the rest training rooms, so the splits share no room. Intrinsics have the
    principal point (W/2, H/2), pixel centres at integers; depth is z in metres and valid everywhere.
    """

    name = "rooms"
    title = "procedural rooms"
    expects = "none: rooms are rendered when they are read"
    metric = True
    splits = ("train", "val", "test", "all")
    needs_root = False
    about = About(
        source="comes with this package",
        licence="Apache-2.0, this package's",
        size="1,500 rooms to train on, 32 to validate, 32 to test",
        roles=(TRAINING, EVALUATION),
    )

    def __init__(
        self,
        split: str = "all",
        *,
        height: int = 96,
        width: int = 128,
        num_frames: int = 96,
        num_rooms: int | None = None,
        style: str = "compass",
        seed: int = 0,
        speed: float | tuple[float, float] = 1.0,
        period: int = 96,
        facing_north: float = 0.0,
    ) -> None:
        """Describes the rooms; nothing is rendered yet.

        Args:
          split: `train`, `val`, `test`, or `all`, the union of the three.
          height: image rows.
          width: image columns.
          num_frames: frames of a sequence, any number; the path repeats after `period` / `speed` frames.
          num_rooms: rooms of each split; default 1,500 for training, 32 each for validation and test.
          style: `compass` (walls keep their colours from room to room) or `random`.
          seed: of the whole set.
          speed: camera speed, 1 = once round the path in `period` frames; a pair (low, high) draws it per room.
          period: frames of one round at speed 1.
          facing_north: share of rooms whose camera swings about one and the same wall instead of looking anywhere.
            A pose relative to the first frame is a difference of two headings: over all headings neither frame
            alone says anything of it, and learning starts late. About one wall each of them does.

        Raises:
          InputError: an option is out of range; names it.
        """
        check_split(split, self)
        if style not in STYLES:
            raise InputError(f"unknown room style {style!r}: choose one of {', '.join(STYLES)}")
        sizes = {"height": height, "width": width, "num_frames": num_frames, "period": period}
        for name, value in (sizes if num_rooms is None else {**sizes, "num_rooms": num_rooms}).items():
            if value < 1:
                raise InputError(f"rooms: {name} must be at least 1, got {value}")
        if seed < 0:
            raise InputError(f"rooms: seed must not be negative, got {seed}")
        low, high = speed if isinstance(speed, Sequence) else (speed, speed)
        if not 0 < low <= high:
            raise InputError(f"rooms: speed must be positive or a pair low <= high, got {speed}")
        if not 0 <= facing_north <= 1:
            raise InputError(f"rooms: facing_north must lie in [0, 1], got {facing_north}")
        self.facing_north = float(facing_north)
        self.split, self.height, self.width, self.style = split, height, width, style
        self.seed, self.speed, self.period = seed, (float(low), float(high)), period
        self._num_frames = num_frames
        self._numbers = _room_numbers(split, num_rooms)
        self.sequences: tuple[str, ...] = tuple(self._numbers)

    @property
    def identity(self) -> dict[str, Any]:
        """The version of what renders the frames, and the options that decide those of a room."""
        return {
            "renderer": _RENDERER_VERSION,
            "height": self.height,
            "width": self.width,
            "num_frames": self._num_frames,
            "style": self.style,
            "seed": self.seed,
            "speed": list(self.speed),
            "period": self.period,
            "facing_north": self.facing_north,
        }

    @classmethod
    def size_options(cls, image_size: tuple[int, int]) -> dict[str, int]:
        """`height` and `width`: rooms are rendered at the size that is asked for."""
        return {"height": image_size[0], "width": image_size[1]}

    def for_training(self, *, cache_dir: str | Path | None, progress: bool) -> Dataset:
        """All frames rendered once, since rendering costs more than training."""
        return render_pool(self, cache_dir=cache_dir, progress=progress)

    def training_split(self) -> "Rooms":
        """All training rooms of these options."""
        return Rooms(
            "train",
            height=self.height,
            width=self.width,
            num_frames=self._num_frames,
            style=self.style,
            seed=self.seed,
            speed=self.speed,
            period=self.period,
            facing_north=self.facing_north,
        )

    def num_frames(self, sequence: str) -> int:
        """Frames of `sequence`: the same for all rooms."""
        check_sequence(sequence, self._numbers, "rooms")
        return self._num_frames

    def image_size(self, sequence: str) -> tuple[int, int]:
        """(H, W): the same for all rooms."""
        check_sequence(sequence, self._numbers, "rooms")
        return self.height, self.width

    def frame_names(self, sequence: str) -> list[str]:
        """`frame-000000` and so on."""
        return [f"frame-{index:06d}" for index in range(self.num_frames(sequence))]

    def room(self, sequence: str) -> Room:
        """Geometry, textures and camera path of `sequence`."""
        check_sequence(sequence, self._numbers, "rooms")
        number = self._numbers[sequence]
        room = _room(self.seed, self.style, number)
        if np.random.default_rng([self.seed, number, 0]).random() < self.facing_north:
            return dataclasses.replace(room, trajectory=room.trajectory.facing_north())
        return room

    def cameras(self, sequence: str, indices: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Intrinsics [T, 3, 3] and world-to-camera extrinsics [T, 4, 4], float32, without rendering."""
        room = self.room(sequence)
        indices = check_indices(indices, self._num_frames, f"rooms, {sequence}")
        low, high = self.speed
        speed = low + (high - low) * np.random.default_rng([self.seed, self._numbers[sequence], 1]).random()
        phases = 2.0 * np.pi * (np.asarray(indices, np.float64) * speed / self.period % 1.0)
        focal = room.focal * self.width
        intrinsics = np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]], np.float32)
        extrinsics = room.trajectory.extrinsics(phases).astype(np.float32)
        return np.tile(intrinsics, (len(indices), 1, 1)), extrinsics

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Renders frames `indices`: under 1 ms a frame of 56 x 70 pixels on one core."""
        intrinsics, extrinsics = self.cameras(sequence, indices)
        room = self.room(sequence)
        views = [
            render(room, pose, calibration, self.height, self.width)
            for pose, calibration in zip(extrinsics, intrinsics, strict=True)
        ]
        images, depth = (np.stack(parts) for parts in zip(*views, strict=True))
        return Frames(images=images, depth=depth, intrinsics=intrinsics, extrinsics=extrinsics, metric=True)


def _room_numbers(split: str, num_rooms: int | None) -> dict[str, int]:
    def number(name: str, position: int) -> int:
        if name == "train":
            return position // 8 * 10 + position % 8
        return position * 10 + {"val": 8, "test": 9}[name]

    names = tuple(_DEFAULT_ROOMS) if split == "all" else (split,)
    numbers = sorted(number(name, i) for name in names for i in range(num_rooms or _DEFAULT_ROOMS[name]))
    return {f"room-{n:05d}": n for n in numbers}


@functools.lru_cache(maxsize=32)
def _room(seed: int, style: str, number: int) -> Room:
    return random_room(np.random.default_rng([seed, number, 2 + STYLES.index(style)]), style)
