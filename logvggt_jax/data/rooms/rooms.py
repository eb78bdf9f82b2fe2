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
from logvggt_jax.data.rooms.layout import MOST_LIGHTS, MOST_ROOMS, STYLES, Furnishing, Room, random_room
from logvggt_jax.data.rooms.pool import render_pool
from logvggt_jax.data.rooms.ray_caster import render
from logvggt_jax.data.rooms.scenes import RoomScenes, Views
from logvggt_jax.data.rooms.trajectories import extrinsics
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames

_RENDERER_VERSION = 1  # raise it whenever the same options give other frames
RENDERERS = ("host", "device")
_SUBFRAMES = 5  # cameras of one blurred frame
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
        renderer: str = "host",
        repetition: float = 0.0,
        lights: int = 0,
        clutter: int = 0,
        rooms: int = 1,
        laps: int = 1,
        motion_blur: float = 0.0,
        exposure: float = 0.0,
    ) -> None:
        """Describes the rooms; nothing is rendered yet.

        Args:
          split: `train`, `val`, `test`, or `all`, the union of the three.
          height: image rows.
          width: image columns.
          num_frames: frames of a sequence, any number; the path repeats after `laps` x `period` / `speed` frames.
          num_rooms: rooms of each split; default 1,500 for training, 32 each for validation and test.
          style: `compass` (walls keep their colours from room to room) or `random`.
          seed: of the whole set.
          speed: camera speed, 1 = once round the path in `period` frames; a pair (low, high) draws it per room.
          period: frames of one round at speed 1.
          facing_north: share of rooms whose camera swings about one and the same wall instead of looking anywhere.
            A pose relative to the first frame is a difference of two headings: over all headings neither frame
            alone says anything of it, and learning starts late. About one wall each of them does.
          renderer: what makes the pictures of training: `host`, once for all and kept, or `device`, from the rooms'
            arrays just before each step, equal to a grey level; other readers always get the host's.
          repetition: share of things whose textures repeat exactly after one period, as tiles and wallpaper do.
          lights: point lights in each room, with hard shadows; 0 lights everything by its direction alone.
          clutter: small things more in each room, on the floor and against its walls.
          rooms: rooms of a sequence, in a row with a door from each to the next; the camera walks through all of
            them and back in one `period`, which several rooms need longer.
          laps: times that the camera walks round its path, each a little aside and looking elsewhere, before it is
            where it began.
          motion_blur: time for which a picture is exposed, as a share of that between frames; its pose and depth
            are those of its middle.
          exposure: stops (powers of two) by which the brightness of frames changes at most, to either side.

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
        if not 0 < low <= high < np.inf:
            raise InputError(f"rooms: speed must be positive or a pair low <= high, got {speed}")
        shares = {"facing_north": facing_north, "repetition": repetition, "motion_blur": motion_blur}
        for name, share in shares.items():
            if not 0 <= share <= 1:
                raise InputError(f"rooms: {name} must lie in [0, 1], got {share}")
        if renderer not in RENDERERS:
            raise InputError(f"rooms: unknown renderer {renderer!r}: choose one of {', '.join(RENDERERS)}")
        limits = {"lights": (lights, 0, MOST_LIGHTS), "clutter": (clutter, 0, 100), "rooms": (rooms, 1, MOST_ROOMS)}
        for name, (value, least, most) in {**limits, "laps": (laps, 1, 100)}.items():
            if not least <= value <= most:
                raise InputError(f"rooms: {name} must lie in [{least}, {most}], got {value}")
        if not 0 <= exposure <= 4:
            raise InputError(f"rooms: exposure must lie in [0, 4] stops, got {exposure}")
        self.facing_north = float(facing_north)
        self.split, self.height, self.width, self.style = split, height, width, style
        self.seed, self.speed, self.period = seed, (float(low), float(high)), period
        self.renderer, self.motion_blur, self.exposure = renderer, float(motion_blur), float(exposure)
        self.furnishing = Furnishing(
            repetition=float(repetition), lights=lights, clutter=clutter, rooms=rooms, laps=laps
        )
        self._num_frames = num_frames
        self._numbers = _room_numbers(split, num_rooms)
        self.sequences: tuple[str, ...] = tuple(self._numbers)

    @property
    def identity(self) -> dict[str, Any]:
        """The version of what renders the frames, and the options that decide those of a room."""
        options = self._options
        # What adds nothing is not named: rooms of earlier versions keep their identity.
        plain = dataclasses.asdict(Furnishing()) | {"motion_blur": 0.0, "exposure": 0.0}
        named = {name: value for name, value in options.items() if plain.get(name) != value}
        return {"renderer": _RENDERER_VERSION, **named, "speed": list(self.speed)}

    @property
    def _options(self) -> dict[str, Any]:
        """The arguments that decide the frames of a room."""
        return {
            "height": self.height,
            "width": self.width,
            "num_frames": self._num_frames,
            "style": self.style,
            "seed": self.seed,
            "speed": self.speed,
            "period": self.period,
            "facing_north": self.facing_north,
            **dataclasses.asdict(self.furnishing),
            "motion_blur": self.motion_blur,
            "exposure": self.exposure,
        }

    @property
    def capacity(self) -> tuple[int, int, int]:
        """The most boxes, spheres and cylinders that any of these rooms has."""
        return self.furnishing.capacity(self.style)

    @classmethod
    def size_options(cls, image_size: tuple[int, int]) -> dict[str, int]:
        """`height` and `width`: rooms are rendered at the size that is asked for."""
        return {"height": image_size[0], "width": image_size[1]}

    def for_training(self, *, cache_dir: str | Path | None, progress: bool) -> Dataset:
        """All frames rendered once, since the host takes longer for them than a step does; or described only."""
        if self.renderer == "device":
            return RoomScenes(self)
        return render_pool(self, cache_dir=cache_dir, progress=progress)

    def training_split(self) -> "Rooms":
        """All training rooms of these options."""
        return Rooms("train", **self._options, renderer=self.renderer)

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
        room = _room(self.seed, self.style, number, self.furnishing)
        if np.random.default_rng([self.seed, number, 0]).random() < self.facing_north:
            return dataclasses.replace(room, trajectory=room.trajectory.facing_north())
        return room

    def cameras(self, sequence: str, indices: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Intrinsics [T, 3, 3] and world-to-camera extrinsics [T, 4, 4], float32, without rendering."""
        views = self.views(sequence, indices)
        return views.intrinsics, views.extrinsics

    def views(self, sequence: str, indices: Sequence[int]) -> Views:
        """Cameras of frames `indices` with their exposure, without rendering."""
        room = self.room(sequence)
        indices = check_indices(indices, self._num_frames, f"rooms, {sequence}")
        number, count = self._numbers[sequence], len(indices)
        low, high = self.speed
        speed = low + (high - low) * np.random.default_rng([self.seed, number, 1]).random()
        subframes = _SUBFRAMES if self.motion_blur else 1
        # Parts of the time between frames, about a frame's own.
        parts = self.motion_blur * ((np.arange(subframes) + 0.5) / subframes - 0.5)
        times = np.asarray(indices, np.float64)[:, None] + parts
        phases = 2.0 * np.pi * (times * speed / self.period % self.furnishing.laps)
        exposures = extrinsics(room.trajectory, phases.ravel()).astype(np.float32)
        exposures = exposures.reshape(count, subframes, 4, 4)
        focal = room.focal * self.width
        intrinsics = np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]], np.float32)
        return Views(
            intrinsics=np.tile(intrinsics, (count, 1, 1)),
            extrinsics=exposures[:, subframes // 2].copy(),
            exposures=exposures,
            gains=self._gains(number, np.asarray(indices, np.float64)),
        )

    def _gains(self, number: int, times: np.ndarray) -> np.ndarray:
        """Factors of the brightness [T] float32: waves of different lengths, as of a camera that adapts."""
        rng = np.random.default_rng([self.seed, number, 2 + len(STYLES)])
        lengths, starts = rng.uniform([8.0, 30.0], [25.0, 100.0]), rng.uniform(0.0, 2.0 * np.pi, 2)
        waves = np.sin(2.0 * np.pi * times[:, None] / lengths + starts).mean(1)
        return np.exp2(self.exposure * waves).astype(np.float32)

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Renders frames `indices`: under 1 ms a frame of 56 x 70 pixels on one core, without further options."""
        views, room = self.views(sequence, indices), self.room(sequence)
        frames = [
            render(room, exposures, calibration, self.height, self.width, gain=gain)
            for exposures, calibration, gain in zip(views.exposures, views.intrinsics, views.gains, strict=True)
        ]
        images, depth = (np.stack(parts) for parts in zip(*frames, strict=True))
        return Frames(images=images, depth=depth, intrinsics=views.intrinsics, extrinsics=views.extrinsics, metric=True)


def _room_numbers(split: str, num_rooms: int | None) -> dict[str, int]:
    def number(name: str, position: int) -> int:
        if name == "train":
            return position // 8 * 10 + position % 8
        return position * 10 + {"val": 8, "test": 9}[name]

    names = tuple(_DEFAULT_ROOMS) if split == "all" else (split,)
    numbers = sorted(number(name, i) for name in names for i in range(num_rooms or _DEFAULT_ROOMS[name]))
    return {f"room-{n:05d}": n for n in numbers}


# A room takes 10 to 100 KB; with fewer, training on the device would lay out each of them in every epoch.
@functools.lru_cache(maxsize=2048)
def _room(seed: int, style: str, number: int, furnishing: Furnishing) -> Room:
    return random_room(np.random.default_rng([seed, number, 2 + STYLES.index(style)]), style, furnishing)
