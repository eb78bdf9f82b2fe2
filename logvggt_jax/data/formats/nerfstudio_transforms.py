"""The cameras of nerfstudio's `transforms.json`, for all that read and write it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from logvggt_jax.data.formats.calibration import pinhole
from logvggt_jax.data.formats.lens import Lens

TRANSFORMS_FILE = "transforms.json"
CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# In OpenCV's order. nerfstudio's k4 of a lens that is no fisheye is another number than OpenCV's.
_RADIAL = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")
_MODELS = {
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), _RADIAL),
    "OPENCV_FISHEYE": _FISHEYE,
}


def lens_of(entry: Mapping[str, Any]) -> Lens | None:
    """The lens of a camera, a frame's own values before those for all frames; None for one that is not among OpenCV's.

    Coefficients may be not finite.
    """
    # instant-ngp's form of the file has a field of its own.
    model = entry.get("camera_model") or ("OPENCV_FISHEYE" if entry.get("is_fisheye") else "PINHOLE")
    values = {name: float(entry.get(name) or 0.0) for name in _DISTORTION}
    if model not in _MODELS or any(values[name] for name in _DISTORTION if name not in _MODELS[model]):
        return None
    return Lens(tuple(values[name] for name in _MODELS[model]), fisheye=_MODELS[model] is _FISHEYE)


def camera_of(entry: Mapping[str, Any]) -> tuple[np.ndarray, float, float]:
    """Intrinsics [3, 3] of a camera that has all of `CAMERA`, centres of pixels at integers, and height and width."""
    fx, fy, cx, cy, width, height = (float(entry[name]) for name in CAMERA)
    return pinhole(fx, fy, cx - 0.5, cy - 0.5), height, width
