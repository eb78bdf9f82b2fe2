"""Lens distortion as OpenCV has it, and pictures and depth as a pinhole would have taken them."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

_RADIAL, _FISHEYE = 8, 4  # coefficients of OpenCV's models
# Radii at which a lens is looked at for where it folds the picture over.
_RADII = 4096


@dataclass(frozen=True)
class Lens:
    """What a lens does to a ray (x, y, 1) of the camera before focal lengths and principal point make a pixel of it.

    Attributes:
      coefficients: k1, k2, p1, p2, k3, k4, k5, k6 of OpenCV's model with rational radial and tangential distortion, or
        k1 … k4 of its `fisheye` model, those left out 0.
      fisheye: which of the two.
    """

    coefficients: tuple[float, ...] = ()
    fisheye: bool = False

    @classmethod
    def of_row(cls, row: Sequence[float] | np.ndarray) -> Lens:
        """Inverse of `row`."""
        fisheye, *coefficients = map(float, row)
        return cls(tuple(coefficients[: _FISHEYE if fisheye else _RADIAL]), bool(fisheye))

    @property
    def row(self) -> np.ndarray:
        """Float64 [9], as listings keep it: 1 for a fisheye, then the coefficients."""
        return np.array([self.fisheye, *self.coefficients, *[0.0] * (_RADIAL - len(self.coefficients))], np.float64)

    @property
    def is_pinhole(self) -> bool:
        """Whether it distorts nothing."""
        return not self.fisheye and not any(self.coefficients)

    def as_pinhole(
        self, picture: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Picture [H, W, 3] and z-depth [H, W] float32 as a pinhole of the same size, focal lengths and principal point
        takes them; None where the lens has seen nothing of what that would see.

        What lies outside of the stored picture is black, with depth 0; what the pinhole does not see is lost. Colours
        are interpolated. Depth is that of the nearest pixel, since between two surfaces there is none.

        Args:
          picture: uint8.
          depth: of the same size.
          intrinsics: [3, 3], pixels with centres at integers.
        """
        sources = _sources(self, intrinsics.tobytes(), depth.shape)
        if not sources.inside.any():
            return None
        colours = cv2.remap(picture, sources.x, sources.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        nearest = cv2.remap(depth, sources.x, sources.y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        colours[~sources.inside], nearest[~sources.inside] = 0, 0.0
        return colours, nearest


class _Sources(NamedTuple):
    """Where in the stored picture each pixel of the pinhole's comes from: float32 [H, W], and bool [H, W], whether that
    is inside of it."""

    x: np.ndarray
    y: np.ndarray
    inside: np.ndarray


# The frames of a sequence have one camera, or one each: of a few the maps are kept, 9 bytes a pixel.
@functools.lru_cache(maxsize=4)
def _sources(lens: Lens, intrinsics: bytes, size: tuple[int, int]) -> _Sources:
    matrix, (height, width) = np.frombuffer(intrinsics).reshape(3, 3), size
    coefficients = lens.row[1 : 1 + (_FISHEYE if lens.fisheye else _RADIAL)]
    shape, kind = (width, height), cv2.CV_32FC1
    with np.errstate(over="ignore", invalid="ignore"):  # of coefficients that no lens has
        if lens.fisheye:
            x, y = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, shape, kind)
        else:
            x, y = cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, shape, kind)
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        columns = (np.arange(width) - matrix[0, 2]) / matrix[0, 0]
        rows = (np.arange(height) - matrix[1, 2]) / matrix[1, 1]
        radius = np.hypot(columns, rows[:, None])
        inside &= radius < _fold(lens.fisheye, coefficients, radius.max())
    return _Sources(np.where(inside, x, np.float32(0.0)), np.where(inside, y, np.float32(0.0)), inside)


def _fold(fisheye: bool, coefficients: np.ndarray, limit: float) -> float:
    """The radius |(x, y)| from which on the distorted radius no longer grows; infinite where that is beyond `limit`.

    A fit to the picture says nothing about rays beyond its edge, where polynomials turn around and would show what is
    in the picture a second time.
    """
    radii = np.linspace(0.0, limit, _RADII)
    if fisheye:
        angle = np.arctan(radii)
        distorted = angle * np.polyval([*coefficients[::-1], 1.0], angle**2)
    else:
        k1, k2, _, _, k3, k4, k5, k6 = coefficients
        distorted = radii * np.polyval([k3, k2, k1, 1.0], radii**2) / np.polyval([k6, k5, k4, 1.0], radii**2)
    turned = ~(np.diff(distorted) > 0)
    return float(radii[turned.argmax()]) if turned.any() else np.inf
