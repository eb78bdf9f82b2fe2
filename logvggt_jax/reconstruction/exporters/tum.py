"""Camera paths in the text format of the TUM RGB-D benchmark, which evo and others read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.files import open_regular, write_text
from logvggt_jax.geometry import (
    LARGEST_ENTRY,
    as_matrix,
    camera_centres,
    invert,
    matrix_to_quaternion,
    quaternion_to_matrix,
)
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

# What is shorter has lost its direction.
_SHORTEST_QUATERNION = 1e-6


def export_tum(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Writes the result's camera-to-world poses, one line a frame; see `write_trajectory`."""
    write_trajectory(path, result.timestamps, result.extrinsics)


def write_trajectory(path: str | Path, timestamps: Sequence[float] | np.ndarray, extrinsics: np.ndarray) -> None:
    """Writes camera-to-world poses as `timestamp tx ty tz qx qy qz qw` lines (TUM RGB-D format).

    Args:
      path: the text file.
      timestamps: [N], seconds or frame numbers, increasing.
      extrinsics: world-to-camera [N, 3|4, 4].

    Raises:
      ValueError: numbers of time stamps and poses differ, or a value is not finite.
    """
    timestamps, extrinsics = np.asarray(timestamps, np.float64), np.asarray(extrinsics, np.float64)
    if len(timestamps) != len(extrinsics):
        raise ValueError(f"{len(timestamps)} time stamps for {len(extrinsics)} poses: one each is needed")
    rotations = np.swapaxes(extrinsics[:, :3, :3], -1, -2)
    rows = np.concatenate([timestamps[:, None], camera_centres(extrinsics), matrix_to_quaternion(rotations)], axis=1)
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(1))[0])
        raise ValueError(f"pose {bad} is not finite: {extrinsics[bad].tolist()}")
    lines = ["# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes)"]
    lines += [f"{row[0]:.6f} " + " ".join(f"{value:.9g}" for value in row[1:]) for row in rows]
    write_text(path, "\n".join(lines) + "\n")


def read_trajectory(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps [N] and world-to-camera extrinsics [N, 4, 4], float64, of a TUM trajectory file.

    Raises:
      InputError: a line does not hold 8 finite numbers, or its quaternion is no rotation; names file and line. Or no
        line holds a pose.
    """
    rows = []
    with open_regular(path) as stream:
        # Bytes that are not UTF-8 become letters that no number has.
        lines = stream.read().decode(errors="backslashreplace").splitlines()
    for number, line in enumerate(lines, start=1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        # Not a number compares as no smaller.
        if len(row) != 8 or not math.isfinite(row[0]) or not all(abs(value) < LARGEST_ENTRY for value in row[1:]):
            raise InputError(
                f"{path}:{number}: expected 8 numbers (timestamp tx ty tz qx qy qz qw), finite ones, got {line!r:.120}"
            )
        if math.hypot(*row[4:]) < _SHORTEST_QUATERNION:
            raise InputError(f"{path}:{number}: the quaternion qx qy qz qw is zero, no rotation, in {line!r:.120}")
        rows.append(row)
    if not rows:
        raise InputError(f"{path} holds no pose: expected lines of timestamp tx ty tz qx qy qz qw")
    values = np.array(rows, np.float64)
    poses = np.concatenate([quaternion_to_matrix(values[:, 4:]), values[:, 1:4, None]], axis=2)
    return values[:, 0], invert(as_matrix(poses))
