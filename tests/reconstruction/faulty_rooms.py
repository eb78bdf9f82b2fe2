"""Walks through procedural rooms with exact cameras and depth, each with one fault of the footage put in."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from logvggt_jax.data.rooms.layout import Room
from logvggt_jax.data.rooms.ray_caster import render
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import encode_poses
from logvggt_jax.streaming import Cameras, FrameResult, Progress, Signals

SIZE = (56, 84)
COUNT = 40
FAULT = range(16, 24)
# A room in which the zoomed view is not of a smooth wall without an edge, which cannot be told from blur.
ZOOMED = 3


def walk(frames: Sequence[int], *, number: int = 0) -> Frames:
    """Frames of a slow walk through a room."""
    rooms = _rooms()
    return rooms.read(rooms.sequences[number], list(frames))


@functools.cache
def clean(number: int = 4) -> Frames:
    """Nothing wrong."""
    return walk(range(COUNT), number=number)


def blurred() -> Frames:
    """Out of focus."""
    return _with_pictures(lambda image: cv2.GaussianBlur(image, (0, 0), 2.5))


def dark() -> Frames:
    """Hardly any light."""
    return _with_pictures(lambda image: (0.06 * image).astype(np.uint8))


def overexposed() -> Frames:
    """Far too much light."""
    return _with_pictures(lambda image: np.clip(6.0 * image, 0, 255).astype(np.uint8))


def flickering() -> Frames:
    """The exposure falls by more than a stop, and comes back."""
    return _with_pictures(lambda image: (0.4 * image).astype(np.uint8))


def plain_wall() -> Frames:
    """The camera turns past a wall without any texture, which fills the picture for a while."""
    room = _room()
    textures, empty = room.textures, np.zeros((0, 3))
    colour = textures.colour.copy()
    colour[1, :, 5] = colour[0, :, 5]
    room = dataclasses.replace(
        room,
        textures=dataclasses.replace(textures, colour=colour),
        box_centres=empty,
        box_half_sizes=empty,
        box_yaws=np.zeros(0),
        sphere_centres=empty,
        sphere_radii=np.zeros(0),
        cylinder_centres=empty,
        cylinder_radii=np.zeros(0),
        cylinder_half_heights=np.zeros(0),
    )
    yaws = np.radians(np.concatenate([np.linspace(-100, -6, FAULT.start), np.linspace(-5, 5, len(FAULT))]))
    yaws = np.concatenate([yaws, np.radians(np.linspace(6, 100, COUNT - FAULT.stop))])
    extrinsics = np.stack([_looking(yaw, np.array([0.2 * np.sin(yaw), 0.0, 0.6])) for yaw in yaws])
    return _rendered([room] * COUNT, extrinsics, np.ones(COUNT))


def jump() -> Frames:
    """The camera is suddenly elsewhere, and looks elsewhere."""
    return walk([*range(FAULT.start), *range(120, 120 + COUNT - FAULT.start)], number=1)


def hurried() -> Frames:
    """The camera moves many times as fast for a while."""
    steps = np.ones(COUNT, int)
    steps[FAULT.start : FAULT.stop] = 13
    return walk(np.cumsum(steps), number=1)


def zoomed() -> Frames:
    """The focal length grows by half within the stretch, and stays."""
    zoom = np.interp(np.arange(COUNT), [FAULT.start, FAULT.stop], [1.0, 1.5])
    return _rendered([_room(ZOOMED)] * COUNT, _poses(range(COUNT), ZOOMED), zoom)


def moving_subject(*, standing: bool = True) -> Frames:
    """A ball rolls through the room, in front of a camera that stands still or walks."""
    extrinsics = _poses([0] * COUNT if standing else range(COUNT))
    room, made = _room(), []
    for frame in range(COUNT):
        # Across the middle picture, two metres away.
        across = np.interp(frame, [FAULT.start, FAULT.stop], [-2.2, 2.2])
        pose = extrinsics[frame].astype(np.float64)
        centre = pose[:3, :3].T @ (np.array([across, 0.0, 1.5]) - pose[:3, 3])
        centres = room.sphere_centres.copy()
        centres[0] = centre
        radii = room.sphere_radii.copy()
        radii[0] = 0.45 if FAULT.start <= frame < FAULT.stop else 1e-3
        made.append(dataclasses.replace(room, sphere_centres=centres, sphere_radii=radii))
    return _rendered(made, extrinsics, np.ones(COUNT))


# What the report calls each fault, and where it is.
FAULTY: dict[str, tuple[Callable[[], Frames], Sequence[int]]] = {
    "blur": (blurred, FAULT),
    "dark": (dark, FAULT),
    "bright": (overexposed, FAULT),
    "exposure": (flickering, (FAULT.start, FAULT.stop)),
    "texture": (plain_wall, FAULT),
    "no overlap": (jump, (FAULT.start,)),
    "fast": (hurried, FAULT),
    "zoom": (zoomed, FAULT),
    "moving": (moving_subject, FAULT),
}


def signals(count: int, faulty: Sequence[int]) -> Signals:
    """As windows give them: small and uneven, and several times as large where something is wrong."""
    noise = np.random.default_rng(0).uniform(0.5, 1.5, (2, count)).astype(np.float32)
    noise[:, list(faulty)] *= 6
    known = Signals.unknown(count)._replace(overlap_change=0.05 * noise[0], correction=0.04 * noise[1])
    known.overlap_change[0] = np.nan
    return known


class Truth:
    """A predictor that hands out the truth, frame by frame.

    `on_push` is called at each frame with the number of those so far.
    """

    def __init__(self, frames: Frames, signals: Signals, on_push: Callable[[int], object] = lambda _: None) -> None:
        self._frames, self._signals, self._on_push = frames, signals, on_push
        self.num_frames = 0
        self.num_pushed = 0

    def push(self, frame: np.ndarray) -> list[FrameResult]:
        self.num_pushed += 1
        self._on_push(self.num_pushed)
        index = self.num_frames
        self.num_frames += 1
        depth = self._frames.depth[index]
        return [FrameResult(index, depth, np.full(depth.shape, 5.0, np.float32), None, False, None, None)]

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        return []

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        return [], {"num_frames": np.array([self.num_frames])}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.num_frames = int(arrays["num_frames"][0])

    def cameras(self) -> Cameras:
        count, frames = self.num_frames, self._frames
        extrinsics, intrinsics = frames.extrinsics[:count, :3], frames.intrinsics[:count]
        encodings = encode_poses(extrinsics, intrinsics, frames.images.shape[1:3]).astype(np.float32)
        return Cameras(encodings, extrinsics, intrinsics, np.ones(count, bool))

    def signals(self) -> Signals:
        return Signals(*(each[: self.num_frames] for each in self._signals))


def _rooms() -> Rooms:
    return Rooms("test", height=SIZE[0], width=SIZE[1], num_frames=400, num_rooms=8, period=240)


def _room(number: int = 0) -> Room:
    rooms = _rooms()
    return rooms.room(rooms.sequences[number])


def _poses(frames: Sequence[int], number: int = 0) -> np.ndarray:
    rooms = _rooms()
    return rooms.cameras(rooms.sequences[number], frames)[1]


def _with_pictures(change: Callable[[np.ndarray], np.ndarray]) -> Frames:
    frames = clean()
    images = frames.images.copy()
    for index in FAULT:
        images[index] = change(images[index])
    return frames._replace(images=images)


def _rendered(rooms: Sequence[Room], extrinsics: np.ndarray, zoom: np.ndarray) -> Frames:
    height, width = SIZE
    intrinsics = np.zeros((len(rooms), 3, 3), np.float32)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = 0.65 * width * zoom
    intrinsics[:, 0, 2], intrinsics[:, 1, 2], intrinsics[:, 2, 2] = width / 2, height / 2, 1
    made = [render(room, [pose], k, height, width) for room, pose, k in zip(rooms, extrinsics, intrinsics, strict=True)]
    images, depth = (np.stack(parts) for parts in zip(*made, strict=True))
    return Frames(images=images, depth=depth, intrinsics=intrinsics, extrinsics=extrinsics, metric=True)


def _looking(yaw: float, place: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]).T
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose
