"""Coloured point clouds as binary PLY files, made from depth maps at constant memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.point_cloud import PointFilter, PointSelection, frame_vertices, write_points
from logvggt_jax.reconstruction.result import Reconstruction


def export_ply(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes the result's depth maps, unprojected, as one cloud with the colours of the frames.

    Args:
      result: the reconstruction.
      path: the PLY file to write.
      point_filter: which pixels become points; None takes `PointFilter`'s defaults.
      progress: show a progress bar where standard error is a terminal.
    """
    selection = PointSelection(point_filter or PointFilter(), result.num_frames)
    with FramePool() as pool:
        frames = pool.map(lambda index: selection.see(index, *_read(result, index)), iter(range(result.num_frames)))
        console = Console(stderr=True)
        hidden = not (progress and console.is_terminal)
        for _ in track(frames, "Points", result.num_frames, console=console, disable=hidden):
            pass
        write_cloud(result, path, selection, pool)


def write_cloud(
    result: Reconstruction,
    path: Path,
    selection: PointSelection,
    pool: FramePool,
    *,
    advance: Callable[[], object] = lambda: None,
) -> None:
    """Writes the points that a selection, which has seen all frames, chooses of them; calls `advance` at each."""

    def vertices(index: int) -> np.ndarray:
        points = selection.choose(index, lambda: _read(result, index))
        # Chosen by the depth as it is stored, since frames are seen before their scale is known.
        points = points._replace(depth=points.depth * np.float32(result.depth_scale[index]))
        return frame_vertices(points, result.depth_size, result.depth_intrinsics[index], result.extrinsics[index])

    def advancing() -> Iterator[np.ndarray]:
        for found in pool.map(vertices, iter(range(result.num_frames))):
            yield found
            advance()

    write_points(path, selection.num_points, advancing())


def _read(result: Reconstruction, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return *result.stored_depth(index), result.image(index)
