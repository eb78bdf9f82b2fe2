"""Coloured point clouds from depth maps, chosen and written frame by frame at constant memory.

Two passes. The first sees depth and confidence of every frame and counts, in a histogram of confidences, the points
that qualify; then the threshold and the exact number of points are known. The second chooses, unprojects and writes.
Frames may go through either pass in any order and at the same time; only their share of the points (`quota`) and the
file are in the frames' order.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import threading
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import atomic_file
from logvggt_jax.geometry import unproject_pixels

VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])

_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    + "".join(f"property {'float' if VERTEX[name] == np.float32 else 'uchar'} {name}\n" for name in VERTEX.names or ())
    + "end_header\n"
)

# Confidences are counted as float16, as which they are stored: a bin a value, up to infinity.
_NUM_BINS = int(np.float16(np.inf).view(np.uint16))


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

    Call `count` for every frame; then `choose` for every frame, and `quota` for every frame in order. `count` and
    `choose` may be called by several threads. What follows from the counts is worked out once, when it is asked for.
    """

    def __init__(self, point_filter: PointFilter) -> None:
        self._filter = point_filter
        self._histogram = np.zeros(_NUM_BINS, np.int64)
        self._lock = threading.Lock()
        self._passed = 0

    def count(self, depth: np.ndarray, confidence: np.ndarray) -> None:
        """First pass over a frame: depth and confidence [H, W]."""
        _, bins = self._candidates(depth, confidence)
        counts = np.bincount(bins, minlength=_NUM_BINS)
        with self._lock:
            self._histogram += counts

    @functools.cached_property
    def threshold_bin(self) -> int:
        """Points of lower bins are left out; the largest bin that leaves out at most the percentile."""
        below = np.concatenate([[0], np.cumsum(self._histogram)[:-1]])
        allowed = self._histogram.sum() * self._filter.confidence_percentile / 100
        return int(np.flatnonzero(below <= allowed)[-1])

    @functools.cached_property
    def num_qualified(self) -> int:
        """Candidates at or above the threshold."""
        return int(self._histogram[self.threshold_bin :].sum())

    @functools.cached_property
    def num_points(self) -> int:
        """The sum of all quotas."""
        limit = self._filter.max_points
        return self.num_qualified if limit is None else min(self.num_qualified, limit)

    def choose(self, frame: int, depth: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, int]:
        """Second pass over a frame: flat indices of its points, increasing, and how many pixels qualify.

        There is an index too many where the frame's quota is rounded down.

        Args:
          frame: its number, which seeds what is left to chance.
          depth: [H, W], as in the first pass.
          confidence: [H, W], as in the first pass.
        """
        indices, bins = self._candidates(depth, confidence)
        indices = indices[bins >= self.threshold_bin]
        qualified = len(indices)
        if self.num_points < self.num_qualified:
            most = -(-qualified * self.num_points // self.num_qualified)
            indices = indices[np.sort(np.random.default_rng(frame).choice(qualified, most, replace=False))]
        return indices, qualified

    def quota(self, qualified: int) -> int:
        """How many points the next frame gets, of whose pixels so many qualify."""
        before, self._passed = self._passed, self._passed + qualified
        # Shares rounded on the running total add up to num_points exactly.
        return self._share(self._passed) - self._share(before)

    def _share(self, passed: int) -> int:
        return passed * self.num_points // max(self.num_qualified, 1)

    def _candidates(self, depth: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flat indices of a frame's candidates, increasing, and the bins of their confidences."""
        indices = np.flatnonzero(self._filter.candidates(depth, confidence))
        known = confidence.reshape(-1)[indices]
        return indices, np.clip(known, 0.0, np.finfo(np.float16).max).astype(np.float16).view(np.uint16)


def frame_vertices(
    depth: np.ndarray, image: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, indices: np.ndarray
) -> np.ndarray:
    """Coloured points [n] of dtype `VERTEX` of the pixels `indices` of one frame.

    Args:
      depth: [H, W] z-depth.
      image: [H, W, 3] uint8 RGB of the same pixels.
      intrinsics: [3, 3] in these pixels.
      extrinsics: [3|4, 4] world-to-camera; the points are in the world.
      indices: [n] flat pixel indices, increasing.
    """
    points = unproject_pixels(depth[None], intrinsics[None], extrinsics[None], indices)
    colours = image.reshape(-1, 3)[indices]
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
            stream.write(vertices.data)
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
