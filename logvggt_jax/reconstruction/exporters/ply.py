"""Coloured point clouds as binary PLY files, made from depth maps at constant memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.progress import track

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
      progress: show a progress bar.
    """
    selection = PointSelection(point_filter or PointFilter())
    for index in range(result.num_frames):
        selection.count(result.depth(index), result.confidence(index))

    def vertices() -> Iterator[np.ndarray]:
        for index in track(range(result.num_frames), description="Points", disable=not progress):
            depth = result.depth(index)
            chosen = selection.choose(depth, result.confidence(index))
            intrinsics, extrinsics = result.depth_intrinsics[index], result.extrinsics[index]
            yield frame_vertices(depth, result.image(index), intrinsics, extrinsics, chosen)

    write_points(path, selection.num_points, vertices())
