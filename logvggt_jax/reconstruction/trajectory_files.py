"""Cameras on disk: trajectories in the TUM format, all of a camera's numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.files import write_text
from logvggt_jax.geometry import (
    as_matrix,
    camera_centres,
    invert,
    matrix_to_quaternion,
    quaternion_to_matrix,
)

CAMERAS_FORMAT = "logvggt-cameras-1"


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
      ValueError: a line does not hold 8 numbers; names file and line.
    """
    rows = []
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        if len(row) != 8:
            raise ValueError(f"{path}:{number}: expected 8 numbers (timestamp tx ty tz qx qy qz qw), got {line!r}")
        rows.append(row)
    values = np.array(rows, np.float64).reshape(-1, 8)
    poses = np.concatenate([quaternion_to_matrix(values[:, 4:]), values[:, 1:4, None]], axis=2)
    return values[:, 0], invert(as_matrix(poses))


def write_cameras(
    path: str | Path,
    *,
    names: Sequence[str],
    timestamps: Sequence[float],
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
    model_intrinsics: np.ndarray,
    model_size: tuple[int, int],
) -> None:
    """Writes all cameras as one JSON file.

    Args:
      path: the JSON file.
      names: N frame names, those of the depth files.
      timestamps: N numbers.
      extrinsics: [N, 3, 4], world-to-camera.
      intrinsics: [N, 3, 3], pixels of the original images.
      image_size: (H, W) of the original images.
      model_intrinsics: [N, 3, 3], pixels of the depth maps.
      model_size: (H, W) of the depth maps.
    """
    frames: list[dict[str, Any]] = [
        {
            "name": name,
            "timestamp": float(timestamp),
            "extrinsics": extrinsics[i].tolist(),
            "intrinsics": intrinsics[i].tolist(),
            "depth_intrinsics": model_intrinsics[i].tolist(),
        }
        for i, (name, timestamp) in enumerate(zip(names, timestamps, strict=True))
    ]
    document = {
        "format": CAMERAS_FORMAT,
        "conventions": "extrinsics [3, 4] are world-to-camera, OpenCV axes (x right, y down, z forward); the world "
        "is the first camera's frame as the model estimates it, lengths are up to one common scale; intrinsics are "
        "in pixels of the original images, depth_intrinsics in pixels of the depth maps; pixel centres lie at "
        "integers",
        "image_size": list(image_size),
        "depth_size": list(model_size),
        "frames": frames,
    }
    write_text(path, json.dumps(document, indent=1) + "\n")


def read_cameras(path: str | Path) -> dict[str, Any]:
    """Inverse of `write_cameras`: the document, with the frames' matrices as float64 arrays.

    Raises:
      FileNotFoundError: no such file.
      ValueError: not a file that `write_cameras` has written.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: expected the output of `logvggt reconstruct`")
    try:
        document = json.loads(path.read_text())
        known = document["format"] == CAMERAS_FORMAT
        for frame in document["frames"]:
            for key in ("extrinsics", "intrinsics", "depth_intrinsics"):
                frame[key] = np.array(frame[key], np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a cameras file of this program: {error!r}") from None
    if not known:
        raise ValueError(f"{path} has format {document['format']!r}, expected {CAMERAS_FORMAT!r}")
    return document
