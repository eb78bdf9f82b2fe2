"""Lost frames of H.264, which its decoders make up without a word: the frames that others refer to are numbered."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

_START_CODE = b"\0\0\1"
_ESCAPED = b"\0\0\3"
# Kinds of units (ITU-T H.264, table 7-1).
_SLICE, _WHOLE_SLICE, _SEQUENCE, _PICTURE = 1, 5, 7, 8
# Bytes within which a slice says which frame it is of.
_SLICE_HEAD = 24
# Bytes within which parameters end.
_LONGEST = 1 << 12
# Profiles whose parameters tell of colours (7.3.2.1.1).
_WITH_COLOURS = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)


class _Sequence(NamedTuple):
    """What a sequence's parameters say of frame numbers: their bits, whether some may be left out, and whether a slice
    names its colour before."""

    bits: int
    gaps: bool
    planes: bool


class FrameNumbers:
    """Follows the numbers of the frames in a stream of H.264.

    Args:
      parameters: what the container knows of the stream (`avcC`); empty where that is in the packets.
    """

    def __init__(self, parameters: bytes = b"") -> None:
        self._sequences: dict[int, _Sequence] = {}
        self._pictures: dict[int, int] = {}
        # Bytes of the length before each unit; 0 where start codes are between them.
        self._length = 0
        self._last: int | None = None
        self._lost = False
        if parameters[:1] == b"\1" and len(parameters) > 6:
            self._length = (parameters[4] & 3) + 1
            for unit in _described(parameters):
                self._note(unit)
        else:
            for unit in _between_start_codes(parameters):
                self._note(unit)

    def follows_loss(self, packet: bytes, key: bool) -> bool:
        """Whether frames between the last key frame and this packet's, which may refer to them, are missing.

        Not known of streams that may leave numbers out.
        """
        self._lost = not key and self._lost
        for unit in _with_lengths(packet, self._length) if self._length else _between_start_codes(packet):
            if unit[0] & 0x1F in (_SLICE, _WHOLE_SLICE):
                self._lost = (self._skips(unit) and not key) or self._lost
                break
            self._note(unit)
        return self._lost

    def _skips(self, unit: bytes) -> bool:
        """Whether the frame that a slice is of does not follow the one before."""
        bits = _Bits(unit[1:_SLICE_HEAD])
        bits.number()
        bits.number()
        sequence = self._sequences.get(self._pictures.get(bits.number(), -1))
        if sequence is None:
            return False
        bits.take(2 * sequence.planes)
        frame, last = bits.take(sequence.bits), self._last
        if unit[0] & 0x60:  # others refer to it
            self._last = frame
        if last is None or sequence.gaps:
            return False
        step = (frame - last) % (1 << sequence.bits)
        # A frame may count from 0 anew, by an operation that is not looked for.
        return step > 1 and not (step > 2 and frame <= 1)

    def _note(self, unit: bytes) -> None:
        """Takes up a unit of parameters."""
        kind = unit[0] & 0x1F
        if kind == _PICTURE:
            bits = _Bits(unit[1:_SLICE_HEAD])
            picture = bits.number()
            self._pictures[picture] = bits.number()
        elif kind == _SEQUENCE and len(unit) > 4:
            bits = _Bits(unit[4:])
            number = bits.number()
            self._sequences[number] = _sequence(bits, unit[1])


class _Bits:
    """Bits of a unit, of which those beyond its end are 0."""

    def __init__(self, content: bytes) -> None:
        content = content.replace(_ESCAPED, _ESCAPED[:2])
        self._bits = int.from_bytes(content, "big")
        self._left = 8 * len(content)

    def take(self, count: int) -> int:
        """The next bits as a number."""
        self._left -= count
        value = self._bits >> self._left if self._left >= 0 else 0
        return value & ((1 << count) - 1)

    def number(self) -> int:
        """A number whose zeros before it tell its length (9.1)."""
        zeros = 0
        while self._left > 0 and zeros < 32 and not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)


def _sequence(bits: _Bits, profile: int) -> _Sequence:
    planes = False
    if profile in _WITH_COLOURS:
        colours = bits.number()
        planes = colours == 3 and bool(bits.take(1))
        bits.number()
        bits.number()
        bits.take(1)
        if bits.take(1):
            for number in range(12 if colours == 3 else 8):
                if bits.take(1):
                    _pass_scales(bits, 16 if number < 6 else 64)
    length = bits.number() + 4
    order = bits.number()
    if order == 0:
        bits.number()
    elif order == 1:
        bits.take(1)
        bits.number()
        bits.number()
        for _ in range(min(bits.number(), 255)):
            bits.number()
    bits.number()
    return _Sequence(min(length, 16), bool(bits.take(1)), planes)


def _pass_scales(bits: _Bits, count: int) -> None:
    last = following = 8
    for _ in range(count):
        if following:
            code = bits.number()
            change = (code + 1) // 2 if code % 2 else -(code // 2)
            following = (last + change) % 256
        last = following or last


def _between_start_codes(content: bytes) -> Iterator[bytes]:
    begin = content.find(_START_CODE)
    while begin >= 0:
        begin += len(_START_CODE)
        end = content.find(_START_CODE, begin, begin + _LONGEST)
        if unit := content[begin : end if end >= 0 else begin + _LONGEST]:
            yield unit
        begin = content.find(_START_CODE, begin)


def _with_lengths(content: bytes, length: int) -> Iterator[bytes]:
    place = 0
    while place + length < len(content):
        size = int.from_bytes(content[place : place + length], "big")
        if unit := content[place + length : place + length + min(size, _LONGEST)]:
            yield unit
        place += length + size


def _described(parameters: bytes) -> Iterator[bytes]:
    """The units in `avcC` (ISO/IEC 14496-15, 5.3.3.1)."""
    place = 5
    for mask in (0x1F, 0xFF):
        for _ in range(parameters[place] & mask if place < len(parameters) else 0):
            place += 1
            size = int.from_bytes(parameters[place : place + 2], "big")
            if unit := parameters[place + 2 : place + 2 + size]:
                yield unit
            place += 1 + size
        place += 1
