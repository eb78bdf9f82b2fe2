"""Lost frames of H.264, which its decoders make up without a word: the frames that others refer to are numbered."""

from __future__ import annotations

from collections.abc import Iterator

from logvggt_jax.reconstruction.sources.bits import Bits
from logvggt_jax.reconstruction.sources.h264_parameters import Sequence, read_sequence

_START_CODE = b"\0\0\1"
# Kinds of units (ITU-T H.264, table 7-1).
_SLICE, _WHOLE_SLICE, _SEQUENCE, _PICTURE = 1, 5, 7, 8
# Bytes within which a slice says which frame it is of.
_SLICE_HEAD = 24
# Bytes within which parameters end.
_LONGEST = 1 << 12


class FrameNumbers:
    """Follows the numbers of the frames in a stream of H.264.

    Args:
      parameters: what the container knows of the stream (`avcC`); empty where that is in the packets.
    """

    def __init__(self, parameters: bytes = b"") -> None:
        self._sequences: dict[int, Sequence] = {}
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
        bits = Bits.unescaped(unit[1:_SLICE_HEAD])
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
            bits = Bits.unescaped(unit[1:_SLICE_HEAD])
            picture = bits.number()
            self._pictures[picture] = bits.number()
        elif kind == _SEQUENCE and len(unit) > 4:
            sequence = read_sequence(unit)
            self._sequences[sequence.number] = sequence


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
