"""Rooms as arrays of fixed shapes, from which a device makes the pictures itself."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.rooms.layout import Room
from logvggt_jax.data.rooms.same_rooms import SameRooms
from logvggt_jax.data.rooms.textures import Textures


class Views(NamedTuple):
    """Cameras of T frames, K for each; numpy, float32."""

    intrinsics: np.ndarray  # [T, 3, 3] pixels
    extrinsics: np.ndarray  # [T, 4, 4] world-to-camera (OpenCV), the frame's pose
    # [T, K, 4, 4] world-to-camera, over whose pictures a frame is the mean; the middle is its pose
    exposures: np.ndarray
    gains: np.ndarray  # [T] factor of the brightness


class DescribedRooms(Dataset, Protocol):
    """What `RoomScenes` needs to know of rooms."""

    @property
    def capacity(self) -> tuple[int, int, int]:
        """The most boxes, spheres and cylinders that any of these rooms has."""
        ...

    def room(self, sequence: str) -> Room:
        """Geometry and textures of `sequence`."""
        ...

    def views(self, sequence: str, indices: Sequence[int]) -> Views:
        """Cameras of frames `indices`."""
        ...


class RoomScenes(SameRooms[DescribedRooms]):
    """The frames of rooms for training, described on the host and drawn on the device; a `DrawnOnDevice`.

    `read` draws on the host: equal to the device's to a grey level.
    """

    def describe(self, sequence: str, indices: Sequence[int]) -> dict[str, np.ndarray]:
        """What `draw` makes frames `indices` from: float32 arrays whose shapes are those of every room."""
        views = self.rooms.views(sequence, indices)
        rotations = views.exposures[:, :, :3, :3]
        origins = -np.einsum("tkji,tkj->tki", rotations, views.exposures[:, :, :3, 3], dtype=np.float64)
        return {
            "intrinsics": views.intrinsics,
            "extrinsics": views.extrinsics,
            "rotations": rotations,
            "origins": origins.astype(np.float32),
            "gains": views.gains,
            **pack(self.rooms.room(sequence), self.rooms.capacity),
        }

    @property
    def draw(self) -> Callable[[Any], Any]:
        """A function of clips for JAX, see `device_renderer.draw_clips`."""
        # Listing and reading data loads no JAX.
        from logvggt_jax.data.rooms.device_renderer import draw_clips

        return functools.partial(draw_clips, size=self.image_size(self.sequences[0]))


def pack(room: Room, capacity: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """`room` as float32 arrays for `capacity` boxes, spheres and cylinders; those that it lacks have impossible sizes.

    Returns `half_size` [3]; `boxes` [N, 8]: centre, half size, cosine and sine of the yaw; `spheres` [N, 4]: centre,
    squared radius; `cylinders` [N, 5]: centre, squared radius, half height; `lights` [N, 4]; and the tables of
    `Textures` by name, their surfaces numbered as those of a room that is full.
    """
    yaws = room.box_yaws[:, None]
    boxes = np.concatenate([room.box_centres, room.box_half_sizes, np.cos(yaws), np.sin(yaws)], axis=1)
    spheres = np.concatenate([room.sphere_centres, room.sphere_radii[:, None] ** 2], axis=1)
    cylinders = np.concatenate(
        [room.cylinder_centres, room.cylinder_radii[:, None] ** 2, room.cylinder_half_heights[:, None]], axis=1
    )
    most_boxes, most_spheres, most_cylinders = capacity
    surfaces = np.concatenate(
        [
            np.arange(6 + 6 * len(boxes)),
            6 + 6 * most_boxes + np.arange(len(spheres)),
            6 + 6 * most_boxes + most_spheres + np.arange(2 * len(cylinders)),
        ]
    )
    count = 6 + 6 * most_boxes + most_spheres + 2 * most_cylinders
    tables = {}
    for field in dataclasses.fields(Textures):
        table = getattr(room.textures, field.name)
        tables[field.name] = np.zeros((*table.shape[:-1], count), np.float32)
        tables[field.name][..., surfaces] = table
    return {
        "half_size": room.half_size.astype(np.float32),
        "boxes": _filled_up(boxes, most_boxes),
        "spheres": _filled_up(spheres, most_spheres),
        "cylinders": _filled_up(cylinders, most_cylinders),
        "lights": room.lights.astype(np.float32),
        **tables,
    }


def _filled_up(things: np.ndarray, count: int) -> np.ndarray:
    """`things` [N, D] as [count, D]; no ray hits a negative size."""
    filled = np.full((count, things.shape[1]), -1.0, np.float32)
    filled[: len(things)] = things
    return filled
