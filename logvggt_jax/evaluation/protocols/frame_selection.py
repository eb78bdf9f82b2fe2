"""Which frames of a sequence are evaluated."""

import dataclasses
import re
import zlib
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.frames import evenly_spaced

Indices = tuple[int, ...]


class FrameSelection(Protocol):
    """From a sequence's name and number of frames to the frames of its clips.

    `wanted` is the number of frames that the benchmark asks for, None for whole sequences. Raises InputError, with
    the reason, for a sequence that gives no clip.
    """

    @property
    def wanted(self) -> int | None: ...

    def __call__(self, sequence: str, num_frames: int) -> Sequence[Indices]: ...

    def describe(self) -> str:
        """For the report."""
        ...


@dataclasses.dataclass(frozen=True)
class Clips:
    """Clips of exactly `wanted` frames at a stride, with evenly spaced starts."""

    wanted: int
    stride: int = 1
    clips_per_sequence: int = 1

    def __call__(self, sequence: str, num_frames: int) -> list[Indices]:
        span = (self.wanted - 1) * self.stride + 1
        if num_frames < span:
            raise InputError(f"has {num_frames} frames, {self.wanted} at stride {self.stride} need {span}")
        starts = evenly_spaced(num_frames - span + 1, self.clips_per_sequence)
        return [tuple(range(start, start + span, self.stride)) for start in starts]

    def describe(self) -> str:
        return f"{self.wanted} frames, stride {self.stride}, {self.clips_per_sequence} clip(s) a sequence"


@dataclasses.dataclass(frozen=True)
class Spread:
    """The first `wanted` frames at the largest stride that has so many; all of a shorter sequence."""

    wanted: int

    def __call__(self, sequence: str, num_frames: int) -> list[Indices]:
        _check(num_frames)
        stride = max(1, num_frames // self.wanted)
        return [tuple(range(0, num_frames, stride))[: self.wanted]]

    def describe(self) -> str:
        return f"{self.wanted} frames at the stride n // {self.wanted} of a sequence of n, from its first"


@dataclasses.dataclass(frozen=True)
class Leading:
    """The first frames at a stride, `wanted` at most (None: to the end), from frame `start`.

    Sequences of the prepared form (`scene0707_00/color_90`, `rgbd_bonn_crowd2/rgb_110`) hold frames that were chosen
    so already: start and stride are not applied again.
    """

    wanted: int | None
    stride: int = 1
    start: int = 0

    def __call__(self, sequence: str, num_frames: int) -> list[Indices]:
        prepared = re.search(r"/(color|rgb)_\d+$", sequence) is not None
        start, stride = (0, 1) if prepared else (self.start, self.stride)
        if num_frames <= start:
            raise InputError(f"has {num_frames} frames, the first that counts is number {start}")
        return [tuple(range(start, num_frames, stride))[: self.wanted]]

    def describe(self) -> str:
        count = "all frames" if self.wanted is None else f"the first {self.wanted} frames"
        return count + (f" from number {self.start}" if self.start else "") + f", stride {self.stride}"


@dataclasses.dataclass(frozen=True)
class RandomFrames:
    """`wanted` frames drawn without replacement, in time order; all of a shorter sequence.

    The draw is a function of the seed and the sequence's name, so that it does not depend on what else is evaluated.
    """

    wanted: int
    seed: int = 0

    def __call__(self, sequence: str, num_frames: int) -> list[Indices]:
        _check(num_frames)
        rng = np.random.default_rng([self.seed, zlib.crc32(sequence.encode())])
        chosen = rng.choice(num_frames, min(self.wanted, num_frames), replace=False)
        return [tuple(sorted(int(i) for i in chosen))]

    def describe(self) -> str:
        return f"{self.wanted} frames drawn at random (seed {self.seed}), in time order"


def _check(num_frames: int) -> None:
    if num_frames < 1:
        raise InputError("has no frames")
