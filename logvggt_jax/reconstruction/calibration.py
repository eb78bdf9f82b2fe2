"""Intrinsics that are known of a sequence, in place of those that the model predicts."""

from __future__ import annotations

import dataclasses

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Calibration:
    """What is known of a sequence's intrinsics.

    Attributes:
      pinhole: focal lengths and principal point (fx, fy, cx, cy) of all frames, in pixels of the original images with
        centres at integers; None where they are not known.
      shared: all frames have one camera, so that the median of the predicted focal lengths serves for all.
    """

    pinhole: tuple[float, float, float, float] | None = None
    shared: bool = False

    def __post_init__(self) -> None:
        if self.pinhole is not None and not (np.isfinite(self.pinhole).all() and min(self.pinhole[:2]) > 0):
            raise InputError(f"intrinsics must be fx,fy,cx,cy in pixels, focal lengths above 0, got {self.pinhole}")

    def check(self, size: tuple[int, int]) -> None:
        """InputError if the principal point lies outside of original images of `size` (H, W)."""
        if self.pinhole is None:
            return
        (_, _, cx, cy), (height, width) = self.pinhole, size
        if not (-0.5 < cx < width - 0.5 and -0.5 < cy < height - 0.5):
            raise InputError(
                f"the principal point {cx:g},{cy:g} lies outside of images of {width} x {height} pixels; intrinsics "
                "are those of the frames at their original size"
            )

    def apply(self, intrinsics: np.ndarray, transform: ResizeTransform) -> np.ndarray:
        """The intrinsics [N, 3, 3] to use in place of the predicted ones; both in pixels of the model's input."""
        result = np.array(intrinsics, np.float64)
        if self.pinhole is not None:
            fx, fy, cx, cy = self.pinhole
            result[:] = transform.intrinsics_from_original(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
        elif self.shared:
            result[:] = np.median(result, axis=0)
        return result
