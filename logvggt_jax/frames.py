"""Frames of a data set, the one value that crosses package borders without JAX; their number and their proportions."""

from typing import NamedTuple

import numpy as np


class Frames(NamedTuple):
    """Frames of one sequence as a dataset hands them out, numpy arrays.

    Attributes:
      images: [T, H, W, 3] uint8 RGB.
      depth: [T, H, W] float32 z-depth, metres where `metric`, 0 where invalid.
      intrinsics: [T, 3, 3] float32, pixels of `images`.
      extrinsics: [T, 4, 4] float32, world-to-camera (OpenCV), NaN where the set has no poses.
      metric: whether lengths are metres.
    """

    images: np.ndarray
    depth: np.ndarray
    intrinsics: np.ndarray
    extrinsics: np.ndarray
    metric: bool


def same_proportions(size: tuple[int, ...], other: tuple[int, ...], tolerance: float = 0.02) -> bool:
    """Whether of two sizes (H, W) one is the other enlarged or reduced: their aspect ratios differ by no larger share
    than the tolerance, which sizes of whole pixels need."""
    return abs(size[1] * other[0] / (size[0] * other[1]) - 1) <= tolerance


def evenly_spaced(count: int, most: int) -> list[int]:
    """At most so many different numbers below `count`, evenly spaced from 0 to `count - 1`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
