"""What is made of a result once its cameras are written: previews, the camera's path, and the point cloud."""

from __future__ import annotations

import shutil
from collections.abc import Callable

from logvggt_jax.frames import evenly_spaced
from logvggt_jax.reconstruction.exporters.ply import write_cloud
from logvggt_jax.reconstruction.exporters.tum import export_tum
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.previews import write_previews
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.result_folder import EXPORT_FOLDER, POINTS_FILE, PREVIEW_FOLDER, TRAJECTORY_FILE


def finish(
    result: Reconstruction,
    selection: PointSelection,
    pool: FramePool,
    *,
    num_previews: int,
    advance: Callable[[], object],
) -> None:
    """Completes a result's folder, in which cameras, images and depth lie.

    Args:
      result: of the folder.
      selection: has seen all frames.
      pool: does the work; has finished it on return.
      num_previews: pictures of frames beside their depth, evenly over the sequence.
      advance: called with every frame whose points are written.
    """
    for name in (PREVIEW_FOLDER, EXPORT_FOLDER):  # of an incomplete result
        shutil.rmtree(result.folder / name, ignore_errors=True)
    write_previews(result, evenly_spaced(result.num_frames, num_previews), pool)
    export_tum(result, result.folder / TRAJECTORY_FILE)
    write_cloud(result, result.folder / POINTS_FILE, selection, pool, advance=advance)
    pool.finish()
