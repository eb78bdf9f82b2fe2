"""The cameras of nerfstudio's `transforms.json`, for all that read and write it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from logvggt_jax.data.formats.calibration import pinhole

TRANSFORMS_FILE = "transforms.json"
CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")


def is_pinhole(entry: Mapping[str, Any]) -> bool:
    """Whether a camera, a frame's own values before those for all frames, is a pinhole without distortion."""
    undistorted = not any(float(entry.get(name) or 0.0) for name in _DISTORTION)
    return undistorted and entry.get("camera_model", "PINHOLE") in _PINHOLES


def camera_of(entry: Mapping[str, Any]) -> tuple[np.ndarray, float, float]:
    """Intrinsics [3, 3] of a camera that has all of `CAMERA`, centres of pixels at integers, and height and width."""
    fx, fy, cx, cy, width, height = (float(entry[name]) for name in CAMERA)
    return pinhole(fx, fy, cx - 0.5, cy - 0.5), height, width
