"""From where a scene is first looked at."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.up_direction import up_direction

# Radians, of the window's height.
_NARROWEST, _WIDEST = np.radians(30.0), np.radians(80.0)
# Of the points before the first camera, those that the opening view shows.
_SHARE = 0.9
# By the distance of what the first camera sees: moving back ends there, and begins where the camera itself, which is
# drawn with its picture, does not stand in the way.
_FARTHEST_BACK, _NEAREST_BACK = 1.0, 0.2
_MOST_POINTS = 50_000


class View(NamedTuple):
    """A place to look from.

    Attributes:
      position: [3] in the world.
      target: [3], what is looked at, and turned around.
      up: [3], unit length, the scene's.
      field_of_view: radians, vertical.
    """

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray
    field_of_view: float


def opening_view(
    extrinsics: np.ndarray, intrinsics: np.ndarray, image_size: tuple[int, int], points: np.ndarray
) -> View:
    """Where the first camera looks from, a little behind it, or as far as it takes to see nine tenths of what lies
    before it.

    Args:
      extrinsics: [N, 3, 4] world-to-camera.
      intrinsics: [N, 3, 3] in pixels of images of `image_size`.
      image_size: (H, W).
      points: [M, 3] in the world; may be none.
    """
    first, (height, width) = np.asarray(extrinsics[0], np.float64), image_size
    field_of_view = float(np.clip(2 * np.arctan(height / 2 / intrinsics[0, 1, 1]), _NARROWEST, _WIDEST))
    points = points[:: max(1, len(points) // _MOST_POINTS)].astype(np.float64)
    seen = points @ first[:, :3].T + first[:, 3]
    seen = seen[seen[:, 2] > 0]
    back, distance = 0.0, 1.0
    if len(seen):
        distance = float(np.median(seen[:, 2]))
        tangents = np.tan(field_of_view / 2) * np.array([width / height, 1.0])
        needed = (np.abs(seen[:, :2]) / tangents).max(axis=1) - seen[:, 2]
        back = float(np.clip(np.quantile(needed, _SHARE), _NEAREST_BACK * distance, _FARTHEST_BACK * distance))
    centre, forward = camera_centres(first[None])[0], first[2, :3]
    up = up_direction(extrinsics)
    return View(centre - back * forward, centre + distance * forward, up, field_of_view)


def camera_view(extrinsics: np.ndarray, up: np.ndarray, field_of_view: float, distance: float) -> View:
    """The view of one camera [3, 4], which turns around what lies at a distance before it."""
    pose = np.asarray(extrinsics, np.float64)
    centre = camera_centres(pose[None])[0]
    return View(centre, centre + distance * pose[2, :3], up, field_of_view)


def scene_span(points: np.ndarray, centres: np.ndarray) -> float:
    """The longest edge of the box that holds the cameras and all but the farthest points; 1 where all is one place."""
    low, high = centres.min(0), centres.max(0)
    if len(points):
        shown = points[:: max(1, len(points) // _MOST_POINTS)].astype(np.float64)
        below, above = np.percentile(shown, (2, 98), axis=0)
        low, high = np.minimum(low, below), np.maximum(high, above)
    return float((high - low).max()) or 1.0


def point_spacing(span: float, count: int) -> float:
    """About how far apart this many points lie on the surfaces of a scene: the size at which they begin to close."""
    return span / max(count, 100) ** 0.5
