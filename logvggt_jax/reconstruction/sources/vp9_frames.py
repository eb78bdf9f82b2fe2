"""Which packets of VP9 show a frame, and its size, which any frame may change (VP9 Bitstream Specification, 6.2)."""

from __future__ import annotations

from collections.abc import Iterator

from logvggt_jax.reconstruction.sources.bits import Bits

Size = tuple[int, int]
_MARKER, _SYNCHRONISED = 2, 0x498342
# The name for colours without a range, and frames that are kept for others to refer to.
_SRGB, _KEPT = 7, 8
# Bytes within which a frame says what is asked here.
_HEAD = 24


class FrameSizes:
    """Follows the sizes of the frames in a stream, of which later ones may take theirs over."""

    def __init__(self) -> None:
        self._kept: list[Size | None] = [None] * _KEPT

    def follow(self, packet: bytes) -> tuple[bool, Size | None]:
        """Whether the packet shows a frame, and its (H, W); None where that is not known."""
        shows, size = False, None
        for frame in _frames(packet):
            if shown := self._frame(Bits(frame[:_HEAD])):
                shows, size = True, shown[0] or size
        return shows, size

    def _frame(self, bits: Bits) -> tuple[Size | None] | None:
        """The size of the frame, None where it is not shown."""
        if bits.take(2) != _MARKER:  # damaged; its decoder will say so
            return (None,)
        profile = bits.take(1) + 2 * bits.take(1)
        if profile == 3:
            bits.take(1)
        if bits.take(1):
            return (self._kept[bits.take(3)],)
        refers, shown, resilient = bits.take(1), bits.take(1), bits.take(1)
        alone = not refers or (not shown and bits.take(1))
        if refers and not resilient:
            bits.take(2)
        if alone:
            if bits.take(24) != _SYNCHRONISED:
                return (None,)
            if not refers or profile:
                _pass_colours(bits, profile)
            refreshed = bits.take(8) if refers else (1 << _KEPT) - 1
            size: Size | None = _stated(bits)
        else:
            refreshed = bits.take(8)
            referred = []
            for _ in range(3):
                referred.append(bits.take(3))
                bits.take(1)
            like = next((each for each in referred if bits.take(1)), None)
            size = _stated(bits) if like is None else self._kept[like]
        for place in range(_KEPT):
            if refreshed >> place & 1:
                self._kept[place] = size
        return (size,) if shown else None


def _stated(bits: Bits) -> Size:
    width, height = bits.take(16) + 1, bits.take(16) + 1
    return height, width


def _pass_colours(bits: Bits, profile: int) -> None:
    if profile >= 2:
        bits.take(1)
    odd = profile in (1, 3)
    bits.take(1 + 3 * odd if bits.take(3) != _SRGB else odd)


def _frames(packet: bytes) -> Iterator[bytes]:
    """The frames in a packet: one, or several with an index behind them (annex B)."""
    mark = packet[-1]
    count, width = (mark & 7) + 1, (mark >> 3 & 3) + 1
    index = packet[-2 - count * width :]
    if mark & 0xE0 != 0xC0 or len(index) != 2 + count * width or index[0] != mark:
        yield packet
        return
    place = 0
    for number in range(count):
        begin = 1 + number * width
        length = int.from_bytes(index[begin : begin + width], "little")
        yield packet[place : place + length]
        place += length
