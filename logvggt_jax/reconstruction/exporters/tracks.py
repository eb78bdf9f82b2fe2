"""A thinned cloud, and in which frames each of its points is seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from logvggt_jax.geometry import project
from logvggt_jax.reconstruction.exporters.cloud import frame_cloud, select_points, tracked
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

NUM_POINTS = 100_000
"""Points of a cloud that is made for splatting: what such programs start from."""

# A point is seen where its distance is the depth map's to this share.
_TOLERANCE = 0.03
# Observations of a point, evenly over the frames that see it; more make files of gigabytes and tell nothing new.
_MOST_OBSERVATIONS = 32
_GATHERED = 64  # observations a point that are held before they are thinned


class Tracks(NamedTuple):
    """Points and their observations, sorted by frame.

    Attributes:
      points: [M, 3] float64 in the world.
      colours: [M, 3] uint8.
      frames: [K] int64, the frame of every observation.
      indices: [K] int64, its point.
      pixels: [K, 2] float64 (u, v) in the pixels of the depth maps, centres at integers.
    """

    points: np.ndarray
    colours: np.ndarray
    frames: np.ndarray
    indices: np.ndarray
    pixels: np.ndarray


def find_tracks(result: Reconstruction, point_filter: PointFilter | None, *, progress: bool) -> Tracks:
    """The points that the filter chooses (None: 100,000), and where they are seen.

    A frame sees a point that projects into it, if its depth there is the point's to 3 %: else something is before it.
    """
    count = result.num_frames
    with FramePool() as pool:
        chosen = point_filter or result.filtered(NUM_POINTS)
        selection = select_points(result, chosen, pool, progress=progress)
        clouds = pool.map(lambda index: frame_cloud(result, selection, index), iter(range(count)))
        vertices = np.concatenate(list(clouds))
        points = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        views = pool.map(lambda index: _seen(result, index, points), iter(range(count)))
        indices, frames = np.zeros(0, np.int32), np.zeros(0, np.int32)
        waiting: list[tuple[np.ndarray, np.ndarray]] = []
        for index, seen in enumerate(tracked(views, "Tracks", count, progress=progress)):
            waiting.append((seen, np.full(len(seen), index, np.int32)))
            # A camera that stays sees every point in every frame: what is gathered is thinned on the way.
            if sum(len(each) for each, _ in waiting) > _GATHERED * len(points) or index == count - 1:
                indices, frames = (np.concatenate(each) for each in zip((indices, frames), *waiting, strict=True))
                kept = _evenly(indices, len(points), _MOST_OBSERVATIONS * (1 if index == count - 1 else 4))
                indices, frames, waiting = indices[kept], frames[kept], []
    pixels = np.empty((len(indices), 2))
    borders = np.searchsorted(frames, np.arange(count + 1))
    for index in range(count):
        part = slice(borders[index], borders[index + 1])
        pixels[part] = project(points[indices[part]], result.depth_intrinsics[index], result.extrinsics[index])[0]
    colours = np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=-1)
    return Tracks(points, colours, frames, indices, pixels)


def _seen(result: Reconstruction, index: int, points: np.ndarray) -> np.ndarray:
    """Which points [n] int32 a frame sees."""
    height, width = result.depth_size
    pixels, depth = project(points, result.depth_intrinsics[index], result.extrinsics[index])
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & ((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5])).all(-1)
    candidates = np.flatnonzero(inside)
    u, v = np.rint(pixels[candidates]).astype(int).T
    stored = result.depth(index)[v, u]
    near = np.abs(stored - depth[candidates]) <= _TOLERANCE * depth[candidates]
    return candidates[near].astype(np.int32)


def _evenly(indices: np.ndarray, num_points: int, most: int) -> np.ndarray:
    """Which observations [k] stay, so that no point has more than `most`; `indices` [K] are their points, by frames."""
    counts = np.bincount(indices, minlength=num_points)
    order = np.argsort(indices, kind="stable")
    first = np.cumsum(counts) - counts
    places = np.empty(len(indices), np.int64)
    places[order] = np.arange(len(indices)) - np.repeat(first, counts)
    step = np.maximum(1, -(-counts // most))
    return np.flatnonzero(places % step[indices] == 0)
