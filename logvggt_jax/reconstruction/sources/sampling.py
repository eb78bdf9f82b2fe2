"""Which frames of a video are taken, and when each of them was recorded."""

from __future__ import annotations

import math

from logvggt_jax.reconstruction.sources.source import SourceOptions

# Containers round time stamps, Matroska to a millisecond.
_ROUNDING = 6e-4
# A time stamp that lies further back than so many frames begins another recording.
_DISORDER = 3


class FrameClock:
    """Makes time stamps from those of a file: they begin at 0 and increase strictly.

    A frame without time stamp follows its predecessor by the average distance. Where the file's clock starts anew
    (recordings that were joined) its times follow those before; one that is merely a little out of order is put right
    behind its predecessor.

    Args:
      rate: frames a second on average; None where it is not known, then frames without time stamp are counted.
    """

    def __init__(self, rate: float | None) -> None:
        self._step = 1.0 / rate if rate else 1.0
        self._zero: float | None = None
        # The zero before the latest, until the next frame says which of both is right.
        self._former: float | None = None
        self._last: float | None = None

    def time(self, stamp: float | None) -> float:
        """Seconds since the first frame of one that has this time stamp in the file."""
        self._last = self._next(stamp)
        return self._last

    def _next(self, stamp: float | None) -> float:
        due = 0.0 if self._last is None else self._last + self._step
        if stamp is None:
            return due
        if self._zero is None or self._last is None:
            self._zero = stamp - due
            return due
        time, former = stamp - self._zero, self._former
        self._former = None
        if former is not None and stamp - former > self._last and abs(stamp - former - due) < abs(time - due):
            self._zero = former
            return stamp - former
        if time > self._last:
            return time
        if time < self._last - _DISORDER * self._step:
            self._former, self._zero = self._zero, stamp - due
            return due
        return self._last + self._step / 2


class FrameSelection:
    """Chooses among the frames of a video as `SourceOptions` says: by position, by time, and by rate.

    Times lie in [start, end). With `fps` time from `start` on is divided into parts of 1 / fps seconds, and the first
    frame of each is taken.
    """

    def __init__(self, options: SourceOptions) -> None:
        self._stride, self._fps = options.stride, options.fps
        self._start = options.start or 0.0
        self._end = math.inf if options.end is None else options.end
        self._part = -1

    def has_begun(self, seconds: float) -> bool:
        """Whether a frame at this time is not before `start`."""
        return seconds >= self._start - _ROUNDING

    def is_over(self, seconds: float) -> bool:
        """Whether this frame and all that follow are left out."""
        return seconds >= self._end - _ROUNDING

    def wants(self, position: int, seconds: float) -> bool:
        """Whether the frame is to be taken."""
        return (
            position % self._stride == 0
            and self.has_begun(seconds)
            and not self.is_over(seconds)
            and (self._fps is None or self._part_of(seconds) > self._part)
        )

    def take(self, seconds: float) -> None:
        """Notes that the frame at this time is taken."""
        self._part = self._part_of(seconds)

    def _part_of(self, seconds: float) -> int:
        return math.floor((seconds - self._start + _ROUNDING) * self._fps) if self._fps is not None else 0


def expected_frames(options: SourceOptions, frames: int | None, rate: float | None) -> int | None:
    """Number of frames that will be taken of so many at a constant rate; None where `frames` is None.

    Args:
      options: which frames are taken.
      frames: frames of the video.
      rate: frames a second; None where it is not known, then time stamps count frames.
    """
    if frames is None:
        return options.max_frames
    rate = rate or 1.0
    first = math.ceil(max(0.0, (options.start or 0.0) - _ROUNDING) * rate)
    last = frames if options.end is None else min(frames, math.ceil((options.end - _ROUNDING) * rate))
    first = -(-first // options.stride) * options.stride
    taken = max(0, -(-(last - first) // options.stride))
    if options.fps is not None and taken:
        taken = min(taken, math.floor(((taken - 1) * options.stride / rate + _ROUNDING) * options.fps) + 1)
    return taken if options.max_frames is None else min(taken, options.max_frames)


def likely_frames(stated: int | None, seconds: float | None, rate: float | None) -> int | None:
    """Number of frames that are shown; an edited file states those as well that it does not show, a file in fragments
    those of the first alone."""
    by_time = max(1, round(seconds * rate)) if seconds and rate else None
    if stated is None or by_time is None:
        return stated or by_time
    return stated if abs(by_time - stated) <= 0.01 * max(by_time, stated) + 2 else by_time
