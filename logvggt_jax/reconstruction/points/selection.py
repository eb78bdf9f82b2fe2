"""The points of a sequence, chosen frame by frame.

A first look at a frame, while depth and image are at hand, counts its candidates in a histogram of confidences and
keeps a sample of them. When all frames have been seen, threshold and number of points are known, and most frames
find their share in their sample; only where it is too small, or every point is wanted, the frame is read again.
"""

from __future__ import annotations

import dataclasses
import functools
import threading
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from logvggt_jax.reconstruction.points.frame_points import FramePoints, frame_points, stored_confidence
from logvggt_jax.reconstruction.points.point_filter import PointFilter

# Confidences are counted as float16, as which they are stored: a bin a value, up to infinity.
_NUM_BINS = int(np.float16(np.inf).view(np.uint16))
# Of a sequence, and of a frame; 17 bytes each.
_MOST_SAMPLES, _FEWEST_SAMPLES = 6_000_000, 64
# Pixels looked at for each that is wanted: more cost more than reading the frame again, where that should be needed.
_LOOK_AHEAD = 4
# Where a video does not say how long it is.
_UNKNOWN_FRAMES = 10_000


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
        self.point_filter = point_filter
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
        candidates = self.point_filter.candidates(depth, confidence).reshape(-1)
        counts = np.bincount(
            stored_confidence(confidence, np.flatnonzero(candidates)).view(np.uint16), minlength=_NUM_BINS
        )
        size = self._sample_size
        order = _random_order(frame, depth.size)[: _LOOK_AHEAD * size]
        places = np.flatnonzero(candidates[order])[:size].astype(np.int32)
        sample = _Sample(frame_points(depth, confidence, image, order[places]), places, int(counts.sum()))
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
        limit = most if self.point_filter.max_points is None else min(most, self.point_filter.max_points)
        other = PointSelection(dataclasses.replace(self.point_filter, max_points=max(limit, 1)), self._frames)
        other._histogram = self._histogram.copy()
        other._samples = {frame: sample for frame, sample in self._samples.items() if frame < frames}
        return other

    @functools.cached_property
    def threshold_bin(self) -> int:
        """Points of lower bins are left out; the largest bin that leaves out at most the percentile."""
        below = np.concatenate([[0], np.cumsum(self._histogram)[:-1]])
        allowed = self._histogram.sum() * self.point_filter.confidence_percentile / 100
        return int(np.flatnonzero(below <= allowed)[-1])

    @functools.cached_property
    def num_qualified(self) -> int:
        """Candidates at or above the threshold."""
        return int(self._histogram[self.threshold_bin :].sum())

    @functools.cached_property
    def num_points(self) -> int:
        """The most points that `choose` hands out over all frames; a few less where frames are too poor for theirs."""
        limit = self.point_filter.max_points
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
        indices = np.flatnonzero(self.point_filter.candidates(depth, confidence))
        indices = indices[stored_confidence(confidence, indices).view(np.uint16) >= self.threshold_bin]
        if self.num_points < self.num_qualified:
            qualified = np.zeros(depth.size, bool)
            qualified[indices] = True
            order = _random_order(frame, depth.size)
            indices = np.sort(order[qualified[order]][:quota])
        return frame_points(depth, confidence, image, indices)


@functools.lru_cache(4)
def _permutation(count: int) -> np.ndarray:
    return np.random.default_rng(0).permutation(count).astype(np.int32)


def _random_order(frame: int, count: int) -> np.ndarray:
    """All pixels [count] in an order of chance, another for each frame: one permutation, begun anywhere."""
    return np.roll(_permutation(count), np.random.default_rng(frame).integers(count))
