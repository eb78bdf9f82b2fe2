"""Camera paths in the text format of KITTI odometry, which evo and others read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from logvggt_jax.files import write_text
from logvggt_jax.geometry import invert
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction


def export_kitti(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes camera-to-world poses (OpenCV axes), a line a frame: the twelve numbers of [3, 4], row by row.

    The format holds no time stamps.
    """
    rows = np.asarray(invert(result.extrinsics))[:, :3].reshape(-1, 12)
    write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows))
