"""Where an evenly timed recording shows nothing for a while: it was paused there, or part of its file is lost."""

from __future__ import annotations

from array import array

import numpy as np

# Frames below which nothing is even.
_FEWEST = 12
# Of steps between frames: how much an even one may differ from the middle one, what is long, and the least and most
# that are of these.
_UNEVEN, _LONG = 0.5, 2.5
_LEAST_EVEN, _MOST_LONG = 0.8, 0.05
# Seconds for which phones drop frames now and then, and from which on a time is damaged.
_SHORTEST, _DAY = 0.5, 86400.0
# The length of a step, as a share, for which a file has to say itself that the frame before is shown.
_STATED = 0.9


class Pauses:
    """Takes down when frames are shown, and finds where there is none for a while.

    A frame that is shown for long because its file says so, as of a screen on which nothing moves, is no pause.
    """

    def __init__(self) -> None:
        self._seconds, self._lasts = array("d"), array("d")

    def add(self, seconds: float, lasts: float | None) -> None:
        """The next frame, shown from then on, and how long by the file itself."""
        self._seconds.append(seconds)
        self._lasts.append(lasts or 0.0)

    def found(self) -> list[tuple[int, float]]:
        """Position of the frame before each pause, and its seconds; none where frames are not evenly timed."""
        if len(self._seconds) < _FEWEST:
            return []
        steps = np.diff(np.array(self._seconds))
        middle = float(np.median(steps))
        even = np.abs(steps - middle) <= _UNEVEN * middle
        stated = np.array(self._lasts)[:-1] >= _STATED * steps
        long = (steps > max(_LONG * middle, _SHORTEST)) & (steps < _DAY) & ~stated
        if even.mean() < _LEAST_EVEN or long.sum() > max(1, _MOST_LONG * len(steps)):
            return []
        return [(int(place), float(steps[place])) for place in np.flatnonzero(long)]
