"""Procedural rooms as a data set: images, exact depth and poses of rooms that exist only as a seed."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from logvggt_jax.data.dataset import check_indices, check_sequence, check_split
from logvggt_jax.data.ray_caster import render
from logvggt_jax.data.room_layout import STYLES, Room, random_room
from logvggt_jax.types import Frames

_DEFAULT_ROOMS = {"train": 1500, "val": 32, "test": 32}


@dataclass(frozen=True)
class Rooms:
    """Furnished box rooms seen along smooth closed camera paths, rendered when read.

    A room is a function of (`seed`, `style`, its number) and each of its frames one of the options and the
    frame's index alone: the same options give the same bytes in any order and process. Numbers ending in 8 are
    validation rooms, in 9 test rooms, the rest training rooms, so the splits share no room. Intrinsics have the
    principal point (W/2, H/2), pixel centres at integers; depth is z in metres and valid everywhere.

    Attributes:
      split: `train`, `val`, `test`, or `all`, the union of the three.
      height, width: image size in pixels.
      num_frames_per_room: frames of a sequence; any length, the path repeats after `period` / `speed` frames.
      num_rooms: rooms of each split; default 1,500 for training, 32 for validation and test.
      style: `compass` (walls keep their colours from room to room) or `random`.
      seed: of the whole set.
      speed: camera speed, 1 = once round the path in `period` frames; a pair draws it for each room.
      period: frames of one round at speed 1.
    """

    split: str = "all"
    height: int = 96
    width: int = 128
    num_frames_per_room: int = 96
    num_rooms: int | None = None
    style: str = "compass"
    seed: int = 0
    speed: float | tuple[float, float] = 1.0
    period: int = 96

    def __post_init__(self) -> None:
        check_split(self.split)
        if self.style not in STYLES:
            raise ValueError(f"unknown room style {self.style!r}: choose one of {', '.join(STYLES)}")
        for name in ("height", "width", "num_frames_per_room", "num_rooms", "period"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"rooms: {name} must be at least 1, got {value}")
        if self.seed < 0:
            raise ValueError(f"rooms: seed must not be negative, got {self.seed}")
        speeds = self.speed if isinstance(self.speed, Sequence) else (self.speed, self.speed)
        if len(speeds) != 2 or not 0 < speeds[0] <= speeds[1]:
            raise ValueError(f"rooms: speed must be positive or a pair low <= high, got {self.speed}")
        object.__setattr__(self, "speed", (float(speeds[0]), float(speeds[1])))

    @functools.cached_property
    def _numbers(self) -> dict[str, int]:
        splits = ("train", "val", "test") if self.split == "all" else (self.split,)
        numbers = sorted(
            _room_number(split, position)
            for split in splits
            for position in range(self.num_rooms or _DEFAULT_ROOMS[split])
        )
        return {f"room-{number:05d}": number for number in numbers}

    @functools.cached_property
    def sequences(self) -> tuple[str, ...]:
        """Room names `room-00012`."""
        return tuple(self._numbers)

    def num_frames(self, sequence: str) -> int:
        """Frames of `sequence`: the same for all rooms."""
        check_sequence(sequence, self.sequences, "rooms")
        return self.num_frames_per_room

    def frame_names(self, sequence: str) -> list[str]:
        """`frame-000000` and so on."""
        return [f"frame-{index:06d}" for index in range(self.num_frames(sequence))]

    def room(self, sequence: str) -> Room:
        """Geometry, textures and camera path of `sequence`."""
        check_sequence(sequence, self.sequences, "rooms")
        return _room(self.seed, self.style, self._numbers[sequence])

    def cameras(self, sequence: str, indices: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Intrinsics [T, 3, 3] and world-to-camera extrinsics [T, 4, 4], float32, without rendering."""
        room = self.room(sequence)
        indices = check_indices(indices, self.num_frames_per_room, f"rooms, {sequence}")
        low, high = self.speed  # type: ignore[misc]
        fraction = np.random.default_rng([self.seed, self._numbers[sequence], 1]).random()
        rounds = np.asarray(indices, np.float64) * (low + fraction * (high - low)) / self.period
        extrinsics = room.trajectory.extrinsics(2.0 * np.pi * (rounds % 1.0))
        focal = room.focal * self.width
        intrinsics = np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]])
        return np.tile(intrinsics, (len(indices), 1, 1)).astype(np.float32), extrinsics.astype(np.float32)

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Renders frames `indices`; about 1 ms a frame of 56 x 70 pixels."""
        intrinsics, extrinsics = self.cameras(sequence, indices)
        room = self.room(sequence)
        views = [
            render(room, pose, calibration, self.height, self.width)
            for pose, calibration in zip(extrinsics, intrinsics, strict=True)
        ]
        images, depth = (np.stack(parts) for parts in zip(*views, strict=True))
        return Frames(images=images, depth=depth, intrinsics=intrinsics, extrinsics=extrinsics, metric=True)


def _room_number(split: str, position: int) -> int:
    if split == "train":
        return position // 8 * 10 + position % 8
    return position * 10 + {"val": 8, "test": 9}[split]


@functools.lru_cache(maxsize=32)
def _room(seed: int, style: str, number: int) -> Room:
    return random_room(np.random.default_rng([seed, number, STYLES.index(style) + 2]), style)
