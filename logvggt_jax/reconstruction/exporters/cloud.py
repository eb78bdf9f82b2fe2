"""The points that go into an export: pixels of a result's frames, chosen as for its own cloud."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.progress import track

from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.cloud_file import frame_vertices
from logvggt_jax.reconstruction.points.frame_points import FramePoints
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.result import Reconstruction

Item = TypeVar("Item")


def select_points(
    result: Reconstruction, point_filter: PointFilter, pool: FramePool, *, progress: bool
) -> PointSelection:
    """Looks at all frames, so that `chosen_points` and `frame_cloud` know which pixels to take."""
    selection = PointSelection(point_filter, result.num_frames)
    frames = pool.map(lambda index: selection.see(index, *_read(result, index)), iter(range(result.num_frames)))
    for _ in tracked(frames, "Points", result.num_frames, progress=progress):
        pass
    return selection


def chosen_points(result: Reconstruction, selection: PointSelection, index: int) -> FramePoints:
    """The points of one frame."""
    points = selection.choose(index, lambda: _read(result, index))
    # Chosen by the depth as it is stored, since frames may be seen before their scale is known.
    return points._replace(depth=points.depth * np.float32(result.depth_scale[index]))


def frame_cloud(result: Reconstruction, selection: PointSelection, index: int) -> np.ndarray:
    """The points of one frame in the world, [n] of dtype `VERTEX`."""
    points = chosen_points(result, selection, index)
    cameras = result.depth_intrinsics[index], result.extrinsics[index]
    return frame_vertices(points, result.depth_size, *cameras, index)


def whole_cloud(result: Reconstruction, point_filter: PointFilter, *, progress: bool) -> np.ndarray:
    """All points that a filter lets through, [n] of dtype `VERTEX`, frame by frame."""
    with FramePool() as pool:
        selection = select_points(result, point_filter, pool, progress=progress)
        clouds = pool.map(lambda index: frame_cloud(result, selection, index), iter(range(result.num_frames)))
        return np.concatenate(list(clouds))


def tracked(items: Iterable[Item], what: str, total: int, *, progress: bool) -> Iterator[Item]:
    """The same items, with a progress bar where one is wanted and standard error is a terminal."""
    console = Console(stderr=True)
    yield from track(items, what, total, console=console, disable=not (progress and console.is_terminal))


def _read(result: Reconstruction, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return *result.stored_depth(index), result.image(index)
