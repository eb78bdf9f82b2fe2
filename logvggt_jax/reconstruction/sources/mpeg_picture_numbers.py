"""Lost pictures of MPEG-1 and MPEG-2, whose pictures are numbered by the place at which their group shows them."""

from __future__ import annotations

import re

# A group's head, a picture's with its number and kind, or a slice, before which both stand (ISO/IEC 13818-2, 6.2).
_HEADS = re.compile(rb"\x00\x00\x01(?:(\xb8)|\x00(..)|[\x01-\xaf])", re.DOTALL)
_BETWEEN = 3  # the kind of pictures to which no other refers, and which refer to one before and one after


class PictureNumbers:
    """Follows the numbers of the pictures in a stream of MPEG-1 or MPEG-2.

    Pictures to which no other refers are lost without harm. That one to which others refer is lost shows where pictures
    lie beyond those between which they have to be, where numbers go back, and where two are farther apart than any
    before while not all that lies between them is there.
    """

    def __init__(self) -> None:
        # Numbers of the last two pictures to which others refer, of this group; and of what was between them.
        self._last: tuple[int | None, int | None] = None, None
        self._between: set[int] = set()
        # How far apart two of them were, where all between them was there.
        self._farthest = 1
        self._lost = False

    def follows_loss(self, packet: bytes, key: bool) -> bool:
        """Whether pictures between the last key frame and this packet's, which may refer to them, are missing."""
        self._lost = not key and self._lost
        for found in _HEADS.finditer(packet):
            if found[1]:
                self._last = None, None
            elif found[2]:
                bits = int.from_bytes(found[2], "big")
                lost = self._skips(bits >> 6, bits >> 3 & 7)
                self._lost = (lost and not key) or self._lost
            else:
                break
        return self._lost

    def _skips(self, number: int, kind: int) -> bool:
        """Whether one to which others refer is missing before the picture of this number and kind."""
        before, last = self._last
        if kind == _BETWEEN:
            first = not self._between
            self._between.add(number)
            if before is None or last is None:
                return last is not None and number > last
            # Once it is known how far they are apart, the first between them tells whether one is missing.
            farther = last - before > self._farthest > 1
            return number > last or (first and farther and number > before + 1)
        if number == last:  # its second field
            return False
        # Numbers begin anew behind a group's head alone, which is lost with the picture behind it.
        lost = last is not None and number < last
        if before is not None and last is not None and last > before:
            whole = self._between.issuperset(range(before + 1, last))
            lost = not whole and last - before > self._farthest
            self._farthest = max(self._farthest, last - before if whole else 1)
        self._last, self._between = (last, number), set()
        return lost
