"""Which frames of a video never come out of its decoder."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator
from fractions import Fraction

from logvggt_jax.reconstruction.sources.decoding import Damage

# Frames that have not come out; no codec holds back so many.
_MOST_WAITING = 512


class MissingFrames:
    """The time stamps of frames that went into a decoder and have not come out, and the errors met on the way.

    Decoders say neither which frame failed nor, often, that one did: it is known by its time stamp, which is passed
    over.

    Args:
      second: of one unit of the time stamps.
    """

    def __init__(self, second: Fraction) -> None:
        self._second = second
        self._waiting: list[int] = []
        self._failures: deque[str] = deque()

    def expect(self, stamp: int) -> None:
        """A frame that is to be shown at this time went in."""
        heapq.heappush(self._waiting, stamp)
        if len(self._waiting) > _MOST_WAITING:
            heapq.heappop(self._waiting)

    def fail(self, reason: str) -> None:
        """A frame could not be read or decoded; which, will be seen."""
        self._failures.append(reason)

    def before(self, shown: float, since: int | None) -> Iterator[Damage]:
        """The frames before the one that is shown at this time that failed, or every one from `since` on that has not
        come out."""
        while self._waiting and self._waiting[0] <= shown:
            stamp = heapq.heappop(self._waiting)
            if stamp < shown and (self._failures or (since is not None and stamp >= since)):
                yield Damage(self._seconds(stamp), self._failures.popleft() if self._failures else "gives no picture")

    def take_next(self) -> int | None:
        """The earliest time stamp that waits, which waits no longer."""
        return heapq.heappop(self._waiting) if self._waiting else None

    def take_failure(self) -> str | None:
        """A failure that no frame which waits explains; it is then done with."""
        return self._failures.popleft() if self._failures else None

    def failures(self) -> Iterator[Damage]:
        """Every failure so far, each in the place of a frame that waits."""
        while self._failures:
            stamp = self.take_next()
            yield Damage(None if stamp is None else self._seconds(stamp), self._failures.popleft())

    def fail_all(self, reason: str) -> None:
        """Every frame that waits failed."""
        self._failures.extend(reason for _ in self._waiting[len(self._failures) :])

    def _seconds(self, stamp: int) -> float:
        return float(stamp * self._second)

    def waits_for(self, stamp: int) -> bool:
        """Whether a frame that is to be shown at this time went in and has not come out."""
        return stamp in self._waiting

    def anything_waits(self) -> bool:
        """Whether a frame went in that has not come out."""
        return bool(self._waiting)
