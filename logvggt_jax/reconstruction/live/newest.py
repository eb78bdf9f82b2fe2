"""The frames that wait between the thread that captures them and the one that uses them."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, NamedTuple, TypeVar

Frame = TypeVar("Frame")


class FrameCounts(NamedTuple):
    """What became of the frames so far; `received` is the sum of the others.

    Attributes:
      received: that came.
      taken: that were taken out, to be used.
      dropped: that newer ones pushed out.
      waiting: that are still there.
    """

    received: int
    taken: int
    dropped: int
    waiting: int


class NewestFrames(Generic[Frame]):
    """At most `capacity` frames wait; when another comes, the one that has waited longest is dropped.

    What is taken out is in the order in which it came. Any thread may call any method.
    """

    def __init__(self, capacity: int) -> None:
        self._frames: deque[Frame] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._received = self._taken = 0
        self._closed = False

    @property
    def counts(self) -> FrameCounts:
        """What became of the frames so far."""
        with self._changed:
            waiting = len(self._frames)
            return FrameCounts(self._received, self._taken, self._received - self._taken - waiting, waiting)

    def put(self, frame: Frame) -> None:
        """Adds the newest frame; never waits. After `close` it is dropped."""
        with self._changed:
            self._received += 1
            if not self._closed:
                self._frames.append(frame)
                self._changed.notify()

    def take(self) -> Frame | None:
        """The frame that has waited longest; waits for one. None once the queue is closed and empty."""
        with self._changed:
            while not self._frames and not self._closed:
                self._changed.wait()
            if not self._frames:
                return None
            self._taken += 1
            return self._frames.popleft()

    def untake(self) -> None:
        """Counts the frame that was taken last as dropped instead."""
        with self._changed:
            self._taken -= 1

    def close(self, *, drop: bool = False) -> None:
        """No more frames come; those that wait can still be taken, unless they are to be dropped."""
        with self._changed:
            self._closed = True
            if drop:
                self._frames.clear()
            self._changed.notify_all()
