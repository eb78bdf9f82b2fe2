"""Which pixels of a depth map become points."""

from __future__ import annotations

import dataclasses

import numpy as np

from logvggt_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class PointFilter:
    """Which pixels become points.

    Attributes:
      confidence_percentile: the share (percent) of candidate pixels, least confident first, that is left out.
      edge_threshold: leave out pixels whose depth differs from a neighbour's by more than this fraction: between
        foreground and background depth maps interpolate points where nothing is. None keeps them.
      pixel_stride: take every n-th pixel of every n-th row.
      max_points: upper bound; more are thinned at random, evenly over all frames. None for no bound.
    """

    confidence_percentile: float = 25.0
    edge_threshold: float | None = 0.1
    pixel_stride: int = 1
    max_points: int | None = 2_000_000

    def __post_init__(self) -> None:
        if not 0 <= self.confidence_percentile < 100:
            raise InputError(f"confidence_percentile must be in [0, 100), got {self.confidence_percentile}")
        if self.edge_threshold is not None and not self.edge_threshold > 0:
            raise InputError(f"edge_threshold must be above 0, got {self.edge_threshold}")
        if self.pixel_stride < 1:
            raise InputError(f"pixel_stride must be at least 1 pixel, got {self.pixel_stride}")
        if self.max_points is not None and self.max_points < 1:
            raise InputError(f"max_points must be at least 1, got {self.max_points}")

    def candidates(self, depth: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        """Pixels of a depth map [H, W] that may become points, whatever the threshold; bool [H, W]."""
        chosen = np.zeros(depth.shape, bool)
        chosen[:: self.pixel_stride, :: self.pixel_stride] = True
        chosen &= np.isfinite(depth) & (depth > 1e-8) & np.isfinite(confidence)
        if self.edge_threshold is not None:
            chosen &= ~_edges(depth, self.edge_threshold)
        return chosen


def _edges(depth: np.ndarray, threshold: float) -> np.ndarray:
    """Pixels [H, W] next to a relative depth step above `threshold` to the right, left, below or above."""
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        low = [slice(None), slice(None)]
        high = [slice(None), slice(None)]
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        a, b = depth[tuple(low)], depth[tuple(high)]
        step = np.abs(a - b) > threshold * np.minimum(np.abs(a), np.abs(b))
        edges[tuple(low)] |= step
        edges[tuple(high)] |= step
    return edges
