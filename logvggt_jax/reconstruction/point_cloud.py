"""Coloured point clouds from depth maps, chosen and written frame by frame at constant memory.

Two passes. The first sees depth and confidence of every frame and counts, in a histogram of confidences, the points
that qualify; then the threshold and the exact number of points are known. The second unprojects and writes frame by
frame.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import atomic_file
from logvggt_jax.geometry import unproject

VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])

_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    + "".join(f"property {'float' if VERTEX[name] == np.float32 else 'uchar'} {name}\n" for name in VERTEX.names or ())
    + "end_header\n"
)

# Bins of log(confidence - 1): 0.5 % wide, from a pixel that the model is certain about to one it knows nothing of.
_BIN_EDGES = np.linspace(-20.0, 20.0, 8001)


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


class PointSelection:
    """The candidates of a sequence, counted by confidence.

    Call `count` for every frame, then `choose` for every frame in the same order.
    """

    def __init__(self, point_filter: PointFilter) -> None:
        self._filter = point_filter
        self._histogram = np.zeros(len(_BIN_EDGES) + 1, np.int64)
        self._passed = 0
        self._frame = 0

    def count(self, depth: np.ndarray, confidence: np.ndarray) -> None:
        """First pass over a frame: depth and confidence [H, W]."""
        bins = _confidence_bin(confidence[self._filter.candidates(depth, confidence)])
        self._histogram += np.bincount(bins, minlength=len(self._histogram))

    @property
    def threshold_bin(self) -> int:
        """Points of lower bins are left out; the largest bin that leaves out at most the percentile."""
        below = np.concatenate([[0], np.cumsum(self._histogram)[:-1]])
        allowed = self._histogram.sum() * self._filter.confidence_percentile / 100
        return int(np.flatnonzero(below <= allowed)[-1])

    @property
    def num_qualified(self) -> int:
        """Candidates at or above the threshold."""
        return int(self._histogram[self.threshold_bin :].sum())

    @property
    def num_points(self) -> int:
        """Points that `choose` hands out over all frames."""
        limit = self._filter.max_points
        return self.num_qualified if limit is None else min(self.num_qualified, limit)

    def choose(self, depth: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        """Second pass over a frame: flat indices of its points, increasing."""
        chosen = self._filter.candidates(depth, confidence)
        indices = np.flatnonzero(chosen)
        indices = indices[_confidence_bin(confidence.reshape(-1)[indices]) >= self.threshold_bin]
        before, self._passed = self._passed, self._passed + len(indices)
        self._frame += 1
        if self.num_points == self.num_qualified:
            return indices
        # Shares rounded on the running total add up to num_points exactly.
        quota = self._share(self._passed) - self._share(before)
        picked = np.random.default_rng(self._frame).choice(len(indices), quota, replace=False)
        return indices[np.sort(picked)]

    def _share(self, passed: int) -> int:
        return passed * self.num_points // self.num_qualified


def frame_vertices(
    depth: np.ndarray, image: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, indices: np.ndarray
) -> np.ndarray:
    """Coloured points [n] of dtype `VERTEX` of the pixels `indices` of one frame.

    Args:
      depth: [H, W] z-depth.
      image: [H, W, 3] uint8 RGB of the same pixels.
      intrinsics: [3, 3] in these pixels.
      extrinsics: [3|4, 4] world-to-camera; the points are in the world.
      indices: [n] flat pixel indices.
    """
    points = unproject(depth.astype(np.float64), intrinsics.astype(np.float64), extrinsics.astype(np.float64))
    points, colours = points.reshape(-1, 3)[indices], image.reshape(-1, 3)[indices]
    vertices = np.empty(len(indices), VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    return vertices


def write_points(path: str | Path, count: int, frames: Iterable[np.ndarray]) -> None:
    """Writes `count` vertices, frame by frame, as a binary PLY file.

    Args:
      path: the PLY file.
      count: of all vertices.
      frames: arrays [n] of dtype `VERTEX`; each is written before the next is asked for.

    Raises:
      ValueError: `frames` hold another number of vertices.
    """
    written = 0
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(_HEADER.format(count=count).encode())
        for vertices in frames:
            stream.write(vertices.astype(VERTEX, copy=False).tobytes())
            written += len(vertices)
        if written != count:
            raise ValueError(f"{path}: {count} vertices announced, {written} given")


def count_points(path: str | Path) -> int:
    """The number of vertices of a file that `write_points` has written, read from its header.

    Raises:
      MissingInput: no such file.
      InputError: it is another file, or cut off.
    """
    return len(_stored_points(Path(path)))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] float32 and colours [M, 3] uint8 of such a file; errors as `count_points`."""
    vertices = _stored_points(Path(path))
    points = np.stack([vertices[name] for name in "xyz"], axis=-1)
    return points, np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)


def _stored_points(path: Path) -> np.ndarray:
    """The vertices [M] of a file, mapped and not read."""
    if not path.is_file():
        raise MissingInput(f"{path} does not exist: expected the output of `logvggt reconstruct`")
    with disk_errors(path), path.open("rb") as stream:
        start = stream.read(2 * len(_HEADER))
    match = re.search(rb"element vertex (\d+)\n", start)
    count = int(match[1]) if match else 0
    header = _HEADER.format(count=count).encode()
    size = len(header) + count * VERTEX.itemsize
    if not start.startswith(header) or path.stat().st_size != size:
        raise InputError(f"{path} is not a point cloud of this program, or is cut off; reconstruct again")
    return np.memmap(path, VERTEX, "r", len(header), (count,)) if count else np.empty(0, VERTEX)


def _confidence_bin(confidence: np.ndarray) -> np.ndarray:
    excess = np.maximum(confidence.astype(np.float64) - 1.0, 1e-30)
    return np.searchsorted(_BIN_EDGES, np.log(excess), side="right")


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
