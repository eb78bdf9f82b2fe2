"""Intrinsics of calibrations that state the picture's size, for pictures that may have been resized since."""

from pathlib import Path

import numpy as np

from logvggt_jax.data.formats.calibration import scaled
from logvggt_jax.errors import InputError

# Cameras of these sets have square pixels; 4:3 for 3:4 or 16:9 for 4:3 is a factor of 1.3 or more.
_PIXEL_ASPECT = 1.2


def relative(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics [3, 3] in pixels of a picture of `size` (H, W) as those of a picture of one pixel."""
    return scaled(intrinsics, 1 / size[1], 1 / size[0])


def in_pixels(intrinsics: np.ndarray, size: tuple[int, int], picture: Path) -> np.ndarray:
    """Intrinsics [3, 3] of a picture of one pixel as those of `picture`, which has `size` (H, W).

    Raises InputError naming `picture` where its pixels would be far from square: it was turned or cropped.
    """
    matrix = scaled(intrinsics, size[1], size[0])
    aspect = matrix[0, 0] / matrix[1, 1]
    if not 1 / _PIXEL_ASPECT < aspect < _PIXEL_ASPECT:
        raise InputError(
            f"{picture}: a picture of {size[1]} x {size[0]} does not have the shape of its calibration (fx / fy would "
            f"be {aspect:.3g}, expected about 1): fetch both again"
        )
    return matrix
