"""Pixels of one frame and what lies there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class FramePoints(NamedTuple):
    """Pixels of one frame and what lies there.

    Attributes:
      indices: [n] flat pixel indices.
      depth: [n] float32 z-depth.
      colours: [n, 3] uint8 RGB.
      confidence: [n] float16, not negative.
    """

    indices: np.ndarray
    depth: np.ndarray
    colours: np.ndarray
    confidence: np.ndarray

    @property
    def bins(self) -> np.ndarray:
        """Bins [n] uint16 of the confidences."""
        return self.confidence.view(np.uint16)

    def at(self, places: np.ndarray) -> FramePoints:
        """The points at these places of the list."""
        return FramePoints(*(values[places] for values in self))


def frame_points(depth: np.ndarray, confidence: np.ndarray, image: np.ndarray, indices: np.ndarray) -> FramePoints:
    """What lies at these flat indices [n] of depth and confidence [H, W] and of an image [H, W, 3] uint8."""
    colours = image.reshape(-1, 3)[indices]
    return FramePoints(indices, depth.reshape(-1)[indices], colours, stored_confidence(confidence, indices))


def stored_confidence(confidence: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """The confidences [n] float16 of some pixels, whose bits are their bins."""
    values = np.clip(confidence.reshape(-1)[indices], 0.0, np.finfo(np.float16).max)
    return np.abs(values).astype(np.float16)  # -0.0 would be a bin of its own
