"""Camera paths in EuRoC MAV's format of ground truth, which evo, Kimera and others read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from logvggt_jax.files import write_text
from logvggt_jax.geometry import camera_centres, matrix_to_quaternion
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

_HEADER = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"


def export_euroc(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes camera-to-world poses (OpenCV axes), a line a frame: nanoseconds, position, quaternion w x y z."""
    centres = camera_centres(result.extrinsics)
    quaternions = matrix_to_quaternion(np.swapaxes(result.extrinsics[:, :, :3], -1, -2))[:, [3, 0, 1, 2]]
    lines = [_HEADER]
    for time, *poses in zip(result.timestamps, centres, quaternions, strict=True):
        numbers = ",".join(f"{value:.12g}" for value in np.concatenate(poses))
        lines.append(f"{round(time * 1e9)},{numbers}")
    write_text(path, "\n".join(lines) + "\n")
