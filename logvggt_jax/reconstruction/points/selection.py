"""Coloured point clouds from depth maps, chosen and written frame by frame.

A first look at a frame, while depth and image are at hand, counts its candidates in a histogram of confidences and
keeps a sample of them. When all frames have been seen, threshold and number of points are known, and most frames
find their share in their sample; only where it is too small, or every point is wanted, the frame is read again.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.files import atomic_file, open_regular
from logvggt_jax.geometry import unproject_pixels

_COLOURED = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
VERTEX = np.dtype([*_COLOURED, ("confidence", "<f4"), ("frame", "<i4")])
# The other one is that of files of earlier versions.
_VERTICES = (VERTEX, np.dtype(_COLOURED))
_PLY_TYPES = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar", np.dtype("<i4"): "int"}


def _header(vertex: np.dtype, count: str) -> str:
    properties = "".join(f"property {_PLY_TYPES[vertex[name]]} {name}\n" for name in vertex.names or ())
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"


# Confidences are counted as float16, as which they are stored: a bin a value, up to infinity.
_NUM_BINS = int(np.float16(np.inf).view(np.uint16))
# Of a sequence, and of a frame; 17 bytes each.
_MOST_SAMPLES, _FEWEST_SAMPLES = 6_000_000, 64
# Pixels looked at for each that is wanted: more cost more than reading the frame again, where that should be needed.
_LOOK_AHEAD = 4
# Where a video does not say how long it is.
_UNKNOWN_FRAMES = 10_000


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


class Cloud(NamedTuple):
    """A point cloud as it is stored.

    Attributes:
      points: [M, 3] float32 in the world, all finite.
      colours: [M, 3] uint8 RGB.
      confidence: [M] float32; None in files of versions that did not store it.
      frame: [M] int32, the number of the frame that a point is a pixel of, in rising order; None likewise.
    """

    points: np.ndarray
    colours: np.ndarray
    confidence: np.ndarray | None
    frame: np.ndarray | None


class _Sample(NamedTuple):
    """The first candidates that a frame's random order meets, their places in it, and the number of all."""

    points: FramePoints
    places: np.ndarray
    candidates: int

    def shortened(self, size: int) -> _Sample:
        """What would have been sampled had `size` points been wanted."""
        kept = min(size, int(np.searchsorted(self.places, _LOOK_AHEAD * size)))
        if kept == len(self.places):
            return self
        # Copies, so that what is left out is let go.
        points = FramePoints(*(values[:kept].copy() for values in self.points))
        return _Sample(points, self.places[:kept].copy(), self.candidates)


class PointSelection:
    """Chooses a sequence's points.

    Call `see` for every frame; then `choose` for every frame. Both may be called in any order and by several
    threads, and what is chosen does not depend on that. What follows from all frames is worked out once, when it is
    first asked for.

    Args:
      point_filter: which pixels become points.
      expected_frames: length of the sequence if it is known; sets the size of samples at first. They shrink when
        more frames are seen, so that all together stay within bounds whatever a file's header has promised.
    """

    def __init__(self, point_filter: PointFilter, expected_frames: int | None) -> None:
        self._filter = point_filter
        # Twice what a mean frame will hand out, since frames differ.
        wanted = 2 * (point_filter.max_points or 0) / (1 - point_filter.confidence_percentile / 100)
        self._kept = min(wanted, _MOST_SAMPLES)
        self._frames = max(expected_frames or _UNKNOWN_FRAMES, 1)
        self._histogram = np.zeros(_NUM_BINS, np.int64)
        self._samples: dict[int, _Sample] = {}
        self._lock = threading.Lock()

    def see(self, frame: int, depth: np.ndarray, confidence: np.ndarray, image: np.ndarray) -> None:
        """First look at a frame.

        Args:
          frame: its number, which seeds what is left to chance.
          depth: [H, W].
          confidence: [H, W].
          image: [H, W, 3] uint8 RGB.
        """
        candidates = self._filter.candidates(depth, confidence).reshape(-1)
        counts = np.bincount(_stored(confidence, np.flatnonzero(candidates)).view(np.uint16), minlength=_NUM_BINS)
        size = self._sample_size
        order = _random_order(frame, depth.size)[: _LOOK_AHEAD * size]
        places = np.flatnonzero(candidates[order])[:size].astype(np.int32)
        sample = _Sample(_points(depth, confidence, image, order[places]), places, int(counts.sum()))
        with self._lock:
            self._histogram += counts
            self._samples[frame] = sample.shortened(self._sample_size)
            if len(self._samples) > self._frames:
                # By a quarter at a time: what is kept depends on how many frames were seen, not on their order.
                self._frames = max(len(self._samples), self._frames * 5 // 4)
                self._samples = {key: each.shortened(self._sample_size) for key, each in self._samples.items()}

    @property
    def _sample_size(self) -> int:
        return max(int(self._kept / self._frames), _FEWEST_SAMPLES)

    def arrays(self) -> dict[str, np.ndarray]:
        """All that was seen, for `restore`."""
        frames = sorted(self._samples)
        samples = [self._samples[frame] for frame in frames]
        points = [sample.points for sample in samples]
        return {
            "histogram": self._histogram,
            "expected": np.array([self._frames]),
            "frames": np.array(frames, np.int64),
            "candidates": np.array([sample.candidates for sample in samples], np.int64),
            "lengths": np.array([len(sample.places) for sample in samples], np.int64),
            "places": np.concatenate([sample.places for sample in samples] or [np.zeros(0, np.int32)]),
            "confidence": np.concatenate([each.confidence for each in points] or [np.zeros(0, np.float16)]),
            "indices": np.concatenate([each.indices for each in points] or [np.zeros(0, np.int64)]),
            "depth": np.concatenate([each.depth for each in points] or [np.zeros(0, np.float32)]),
            "colours": np.concatenate([each.colours for each in points] or [np.zeros((0, 3), np.uint8)]),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave."""
        self._histogram, self._frames = arrays["histogram"].copy(), int(arrays["expected"][0])
        ends = np.cumsum(arrays["lengths"])
        for frame, stop, length, candidates in zip(
            arrays["frames"].tolist(), ends, arrays["lengths"], arrays["candidates"].tolist(), strict=True
        ):
            part = slice(stop - length, stop)
            points = FramePoints(*(arrays[name][part] for name in FramePoints._fields))
            self._samples[frame] = _Sample(points, arrays["places"][part], candidates)

    def first(self, frames: int, *, most: int) -> PointSelection:
        """What is chosen of the first frames alone, `most` points at most; of their confidences all are weighed."""
        limit = most if self._filter.max_points is None else min(most, self._filter.max_points)
        other = PointSelection(dataclasses.replace(self._filter, max_points=max(limit, 1)), self._frames)
        other._histogram = self._histogram.copy()
        other._samples = {frame: sample for frame, sample in self._samples.items() if frame < frames}
        return other

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
        """The most points that `choose` hands out over all frames; a few less where frames are too poor for theirs."""
        limit = self._filter.max_points
        return self.num_qualified if limit is None else min(self.num_qualified, limit)

    @functools.cached_property
    def _quotas(self) -> dict[int, int]:
        """Points of each frame, where there have to be less than qualify: by what its sample says of it."""
        frames = sorted(self._samples)
        samples = [self._samples[frame] for frame in frames]
        total = np.cumsum(
            [np.sum(s.points.bins >= self.threshold_bin) * s.candidates / max(len(s.places), 1) for s in samples],
            dtype=float,
        )
        # Shares rounded on the running total add up exactly.
        shares = np.floor(total / max(total[-1], 1e-9) * self.num_points).astype(int)
        return dict(zip(frames, np.diff(shares, prepend=0).tolist(), strict=True))

    def choose(self, frame: int, read: Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]) -> FramePoints:
        """The points of a frame, in the order of its pixels; `read` gives what `see` was given, if need be."""
        if self.num_points < self.num_qualified:
            quota, sample = self._quotas[frame], self._samples[frame]
            places = np.flatnonzero(sample.points.bins >= self.threshold_bin)[:quota]
            if len(places) == quota or len(sample.places) == sample.candidates:
                return sample.points.at(places[np.argsort(sample.points.indices[places])])
        depth, confidence, image = read()
        indices = np.flatnonzero(self._filter.candidates(depth, confidence))
        indices = indices[_stored(confidence, indices).view(np.uint16) >= self.threshold_bin]
        if self.num_points < self.num_qualified:
            qualified = np.zeros(depth.size, bool)
            qualified[indices] = True
            order = _random_order(frame, depth.size)
            indices = np.sort(order[qualified[order]][:quota])
        return _points(depth, confidence, image, indices)


def frame_vertices(
    points: FramePoints, size: tuple[int, int], intrinsics: np.ndarray, extrinsics: np.ndarray, frame: int
) -> np.ndarray:
    """Coloured points [n] of dtype `VERTEX` in the world.

    Args:
      points: [n] of one frame, in the order of its pixels.
      size: (H, W) of the frame.
      intrinsics: [3, 3] in its pixels.
      extrinsics: [3|4, 4] world-to-camera.
      frame: its number.
    """
    depth = np.zeros(size, np.float32)
    depth.reshape(-1)[points.indices] = points.depth
    positions = unproject_pixels(depth[None], intrinsics[None], extrinsics[None], points.indices)
    vertices = np.empty(len(positions), VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = points.colours[:, channel]
    vertices["confidence"], vertices["frame"] = points.confidence, frame
    return vertices


def write_points(path: str | Path, most: int, frames: Iterable[np.ndarray]) -> None:
    """Writes vertices, frame by frame, as a binary PLY file.

    Args:
      path: the PLY file.
      most: number of vertices at most.
      frames: arrays [n] of dtype `VERTEX`; each is written before the next is asked for.

    Raises:
      ValueError: `frames` hold more vertices.
    """
    written = 0
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(_header(VERTEX, str(most)).encode())
        for vertices in frames:
            stream.write(vertices.data)
            written += len(vertices)
        if written > most:
            raise ValueError(f"{path}: {most} vertices announced, {written} given")
        stream.seek(0)
        # As long as before: readers skip blanks.
        stream.write(_header(VERTEX, str(written).rjust(len(str(most)))).encode())


def count_points(path: str | Path) -> int:
    """The number of vertices of a file that `write_points` has written, read from its header.

    Raises:
      MissingInput: no such file.
      InputError: it is another file, or cut off.
    """
    return len(_stored_points(Path(path)))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] float32, all finite, and colours [M, 3] uint8 of such a file; errors as `count_points`."""
    return read_cloud(path)[:2]


def read_cloud(path: str | Path) -> Cloud:
    """All that such a file holds; errors as `count_points`."""
    vertices = _stored_points(Path(path))
    points = np.stack([vertices[name] for name in "xyz"], axis=-1)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{path} is damaged: {np.count_nonzero(~finite):,} of its {len(points):,} points are not finite; "
            "reconstruct again"
        )
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
    if "frame" not in (vertices.dtype.names or ()):
        return Cloud(points, colours, None, None)
    confidence, frame = np.array(vertices["confidence"]), np.array(vertices["frame"])
    if not np.isfinite(confidence).all() or (np.diff(frame) < 0).any() or (frame[:1] < 0).any():
        raise InputError(f"{path} is damaged: its points' confidences or frames make no sense; reconstruct again")
    return Cloud(points, colours, confidence, frame)


def _stored_points(path: Path) -> np.ndarray:
    """The vertices [M] of a file, mapped and not read."""
    try:
        with open_regular(path) as stream:
            start, found = stream.read(2 * len(_header(VERTEX, ""))), os.fstat(stream.fileno()).st_size
            # More digits could not be a size.
            match = re.search(rb"element vertex ( *\d{1,18})\n", start)
            count = int(match[1]) if match else 0
            headers = {each: _header(each, match[1].decode()).encode() for each in _VERTICES} if match else {}
            vertex = next((each for each, header in headers.items() if start.startswith(header)), None)
            if vertex is None:
                raise InputError(f"{path} is {_other_file(start)}: expected the output of `logvggt reconstruct`")
            size = len(headers[vertex]) + count * vertex.itemsize
            if found != size:
                raise InputError(
                    f"{path} is {'cut off' if found < size else 'longer than its header says'}: {count:,} points need "
                    f"{size:,} bytes, it has {found:,}; copy it again or reconstruct again"
                )
            return np.memmap(stream, vertex, "r", len(headers[vertex]), (count,)) if count else np.empty(0, vertex)
    except MissingInput:
        raise MissingInput(f"{path} does not exist: expected the output of `logvggt reconstruct`") from None


def _other_file(start: bytes) -> str:
    """What a file is whose first bytes are not those of a cloud of ours."""
    if not start:
        return "empty"
    if not start.startswith(b"ply"):
        return "no PLY file"
    return "cut off in its header" if b"end_header" not in start else "a PLY file of another program, or damaged"


def _points(depth: np.ndarray, confidence: np.ndarray, image: np.ndarray, indices: np.ndarray) -> FramePoints:
    colours = image.reshape(-1, 3)[indices]
    return FramePoints(indices, depth.reshape(-1)[indices], colours, _stored(confidence, indices))


def _stored(confidence: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """The confidences [n] float16 of some pixels, whose bits are their bins."""
    values = np.clip(confidence.reshape(-1)[indices], 0.0, np.finfo(np.float16).max)
    return np.abs(values).astype(np.float16)  # -0.0 would be a bin of its own


@functools.lru_cache(4)
def _permutation(count: int) -> np.ndarray:
    return np.random.default_rng(0).permutation(count).astype(np.int32)


def _random_order(frame: int, count: int) -> np.ndarray:
    """All pixels [count] in an order of chance, another for each frame: one permutation, begun anywhere."""
    return np.roll(_permutation(count), np.random.default_rng(frame).integers(count))


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
