"""Whether pictures show two moments in alternate lines, as interlaced captures do of which nothing in the file says so.

The lines of one moment, the field, lie between those of the other. Of two pictures that follow each other, the odd
lines of the first are compared with what the even ones of the second have between them, and the even lines of the first
with the odd ones of the second:

    whole pictures          both are a picture apart, and differ alike
    even lines come first   odd before even: one field apart; even before odd: three
    odd lines come first    the other way round
"""

import numpy as np

# Pictures from one pair that is looked at to the next, which is no multiple of any pattern, and the most pairs.
_EVERY, _MOST = 7, 100
# Every so many columns tell enough.
_COLUMNS = 4
# Grey levels from one picture to the next that count as motion, and the share of a picture that has to move.
_MOTION, _LEAST_MOVING = 12, 0.005
# How much more one comparison differs than the other where pictures show two moments. Of whole pictures it was 1.13 at
# most; a movement that is longer than its own texture takes that of two moments down to 1.
_APART = 1.25
# How much more lines may differ from those of the other picture than from their neighbours where there are two moments.
_WHOLE = 1.5
# How much more lines that go in pairs differ on one side than on the other, as in pictures that were enlarged. What
# these show can move just as two moments do, which is why they are left out; so is what moves straight up or down.
_PAIRED = 2.0
# Pairs that tell, and their share of those that move: where a film became television, it is two in five.
_FEWEST, _LEAST_SHARE = 3, 0.3


class AlternateLines:
    """Looks at pairs of a video's pictures, spread over its beginning."""

    def __init__(self) -> None:
        self._before: tuple[int, np.ndarray] | None = None
        self._ratios: list[float] = []
        self._pairs = 0

    def wants(self, position: int) -> bool:
        """Whether the picture at this position of the video is to be looked at."""
        return self._pairs < _MOST and position % _EVERY < 2

    def add(self, position: int, image: np.ndarray) -> None:
        """The picture at a position that is wanted, [H, W, 3] uint8."""
        lines = image[: len(image) // 2 * 2, ::_COLUMNS, 1].astype(np.int16)
        if self._before is not None and position == self._before[0] + 1 and lines.shape == self._before[1].shape:
            self._pairs += 1
            ratio = _ratio(self._before[1], lines)
            self._ratios += [] if ratio is None else [ratio]
        self._before = (position, lines)

    def found(self) -> bool:
        """Whether the pictures that moved show two moments, the same lines always first."""
        ratios = np.array(self._ratios)
        first, last = int((ratios > _APART).sum()), int((ratios < 1 / _APART).sum())
        return (
            max(first, last) >= max(_FEWEST, _LEAST_SHARE * len(ratios)) and min(first, last) <= max(first, last) / 10
        )


def _ratio(before: np.ndarray, after: np.ndarray) -> float | None:
    """How much more even lines differ from the odd ones of the picture after theirs than odd lines from the even ones.

    None where too little moves, or where lines go in pairs. 1 where lines of one picture go together better than with
    those of the other. Pictures are [H, W] int16 with an even number of lines.
    """
    moving = np.abs(after - before) > _MOTION
    # A field moves where either of its neighbours in the other picture does.
    even, odd = moving[2::2] | moving[1:-1:2] | moving[3::2], moving[1:-1:2] | moving[0:-2:2] | moving[2::2]
    if min(even.mean(), odd.mean()) < _LEAST_MOVING:
        return None
    paired, unpaired = _apart(before[0:-2:2] - before[1:-1:2]), _apart(before[1:-1:2] - before[2::2])
    if not 1 / _PAIRED < paired / unpaired < _PAIRED:
        return None
    odd_to_even, odd_within = (_apart((before[1:-1:2] - (x[0:-2:2] + x[2::2]) // 2)[odd]) for x in (after, before))
    even_to_odd, even_within = (_apart((before[2::2] - (x[1:-1:2] + x[3::2]) // 2)[even]) for x in (after, before))
    if min(odd_to_even / odd_within, even_to_odd / even_within) > _WHOLE:
        return 1.0
    return even_to_odd / odd_to_even


def _apart(differences: np.ndarray) -> float:
    """Their mean size; never zero."""
    return float(np.abs(differences).mean()) + 1.0
