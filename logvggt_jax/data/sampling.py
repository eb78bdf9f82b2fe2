"""Which frames of a sequence make a training clip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ClipSampler:
    """Clips of evenly spaced frames in time order, with random stride, start and direction.

    Attributes:
      length: frames of a clip.
      stride: smallest and largest distance between neighbouring frames; drawn uniformly from the strides with
        which a clip fits into the sequence.
      reverse: probability that a clip runs backwards in time.
    """

    length: int
    stride: tuple[int, int] = (1, 1)
    reverse: float = 0.5

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"clip length must be at least 1, got {self.length}")
        if len(self.stride) != 2 or not 1 <= self.stride[0] <= self.stride[1]:
            raise ValueError(f"clip stride must be a pair 1 <= low <= high, got {self.stride}")
        if not 0 <= self.reverse <= 1:
            raise ValueError(f"the probability of reversed clips must lie in [0, 1], got {self.reverse}")

    @property
    def shortest(self) -> int:
        """Frames that a sequence needs to hold a clip."""
        return (self.length - 1) * self.stride[0] + 1

    def indices(self, num_frames: int, rng: np.random.Generator) -> np.ndarray:
        """Frame indices [length] int64 of one clip from a sequence of `num_frames` frames.

        Raises ValueError where no clip fits.
        """
        if num_frames < self.shortest:
            raise ValueError(
                f"a clip of {self.length} frames with stride {self.stride[0]} needs {self.shortest} frames, "
                f"the sequence has {num_frames}: shorten the clip or leave the sequence out"
            )
        widest = self.stride[1] if self.length == 1 else min(self.stride[1], (num_frames - 1) // (self.length - 1))
        stride = int(rng.integers(self.stride[0], widest + 1))
        span = (self.length - 1) * stride
        start = int(rng.integers(0, num_frames - span))
        clip = start + stride * np.arange(self.length)
        return clip[::-1].copy() if rng.random() < self.reverse else clip


def example_rng(seed: int, index: int) -> np.random.Generator:
    """The random generator of training example `index`: a function of (`seed`, `index`) alone."""
    return np.random.default_rng([seed, index])
