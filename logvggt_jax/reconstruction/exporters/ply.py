"""Coloured point clouds as binary PLY files, made from depth maps at constant memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from logvggt_jax.reconstruction.exporters.cloud import frame_cloud, select_points
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.cloud_file import write_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.result import Reconstruction


def export_ply(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes the result's depth maps, unprojected, as one cloud with the colours of the frames.

    Args:
      result: the reconstruction.
      path: the PLY file to write.
      point_filter: which pixels become points; None takes the result's own filter.
      progress: show a progress bar where standard error is a terminal.
    """
    with FramePool() as pool:
        selection = select_points(result, point_filter or result.point_filter, pool, progress=progress)
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

    def advancing() -> Iterator[np.ndarray]:
        frames = iter(range(result.num_frames))
        for found in pool.map(lambda index: frame_cloud(result, selection, index), frames):
            yield found
            advance()

    write_points(path, selection.num_points, advancing())
