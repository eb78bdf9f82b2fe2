"""Ends a process in which nothing moves any more, with the stacks of all its threads, so that a cluster restarts it."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import statistics
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator

# Not before this, however quick the steps are: a network disk may be slow for minutes.
LEAST_SECONDS = 300.0
# A compilation, a save, a validation, the reading of the first clips.
OTHER_SECONDS = 3600.0
_REMEMBERED = 100
# The stacks are written this much later than the line about them, by a thread that no lock of Python can hold up.
_GRACE = 1.0


class Watchdog:
    """While entered, ends the process when no step has ended for `factor` times the median step; 0 watches nothing.

    Args:
      factor: of the median time of the last steps.
      least: seconds, below which nothing ends the process.
      other: seconds for what is no step.
    """

    def __init__(self, factor: float, *, least: float = LEAST_SECONDS, other: float = OTHER_SECONDS) -> None:
        self._factor, self._least, self._other = factor, least, other
        self._seconds: deque[float] = deque(maxlen=_REMEMBERED)
        self._last: float | None = None
        self._deadline, self._reason = 0.0, ""
        self._changed = threading.Condition()
        self._entered = False

    def __enter__(self) -> Watchdog:
        if self._factor and (file := sys.__stderr__) is not None:
            self._stacks = file
            self._entered = True
            self._allow(self._other, "nothing has ended")
            threading.Thread(target=self._watch, name="watchdog", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._entered:
            return
        with self._changed:
            self._entered = False
            self._changed.notify()
        faulthandler.cancel_dump_traceback_later()

    def step_ended(self) -> None:
        """Notes the end of a step; the next one is due in the time that the last ones took."""
        now = time.monotonic()
        if self._last is not None:
            self._seconds.append(now - self._last)
        self._last = now
        if not self._entered:
            return
        if self._seconds:
            self._allow_a_step("")
        else:
            self._allow(self._other, "no second step has ended")

    @contextlib.contextmanager
    def other(self, what: str, *, then_clips: bool = False) -> Iterator[None]:
        """Time for what is no step, such as a validation; with `then_clips` those of another stage are read after it,
        which may take as long."""
        if self._entered:
            self._allow(self._other, f"{what} has not ended")
        yield
        # The next step is not measured from the one before.
        self._last = None
        if self._entered and self._seconds and not then_clips:
            self._allow_a_step(f"since {what} ")
        elif self._entered:
            self._allow(self._other, f"no step has ended since {what}")

    def _allow_a_step(self, since: str) -> None:
        median = statistics.median(self._seconds)
        self._allow(max(self._least, self._factor * median), f"no step has ended {since}(the median is {median:.3g} s)")

    def _allow(self, seconds: float, reason: str) -> None:
        seconds = min(seconds, threading.TIMEOUT_MAX - _GRACE)  # three centuries
        with self._changed:
            self._deadline = time.monotonic() + seconds
            self._reason = f"for {seconds:.0f} s {reason}"
            self._changed.notify()
        # Needs no interpreter: it also ends a process in which a library holds its lock for ever.
        faulthandler.dump_traceback_later(seconds + _GRACE, exit=True, file=self._stacks)

    def _watch(self) -> None:
        with self._changed:
            while self._entered:
                left = self._deadline - time.monotonic()
                if left > 0:
                    self._changed.wait(left)
                    continue
                line = f"watchdog: {self._reason}: process {os.getpid()} ends, the stacks of its threads follow\n"
                os.write(self._stacks.fileno(), line.encode())
                return
