"""The parameters of a sequence of H.264 (ITU-T H.264, 7.3.2.1.1)."""

from __future__ import annotations

from typing import NamedTuple

from logvggt_jax.reconstruction.sources.bits import Bits

# Profiles whose parameters tell of colours.
_WITH_COLOURS = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)
# Of formats of colours, how many columns and rows of light share a sample of colour; the first is grey.
SHARED = ((1, 1), (2, 2), (2, 1), (1, 1))


class Sequence(NamedTuple):
    """What a sequence's parameters say.

    Attributes:
      number: by which pictures' parameters name it.
      bits: of the numbers of frames.
      gaps: some numbers may be left out.
      planes: a slice names its colour before its frame's number.
      size: (H, W) of the part that is shown.
    """

    number: int
    bits: int
    gaps: bool
    planes: bool
    size: tuple[int, int]


def read_sequence(unit: bytes) -> Sequence:
    """Of a unit of parameters, from its kind on, as it is stored."""
    profile, bits = unit[1], Bits.unescaped(unit[4:])
    number = bits.number()
    colours, planes = 1, False
    if profile in _WITH_COLOURS:
        colours = min(bits.number(), 3)
        planes = colours == 3 and bool(bits.take(1))
        bits.number()
        bits.number()
        bits.take(1)
        if bits.take(1):
            for scales in range(12 if colours == 3 else 8):
                if bits.take(1):
                    _pass_scales(bits, 16 if scales < 6 else 64)
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
    gaps = bool(bits.take(1))
    width, height = 16 * (bits.number() + 1), 16 * (bits.number() + 1)
    fields = 2 - bits.take(1)
    if fields == 2:
        bits.take(1)
    bits.take(1)
    if bits.take(1):
        columns, rows = (1, 1) if planes else SHARED[colours]
        width -= columns * (bits.number() + bits.number())
        height -= rows * (bits.number() + bits.number())
    return Sequence(number, min(length, 16), gaps, planes, (height * fields, width))


def _pass_scales(bits: Bits, count: int) -> None:
    last = following = 8
    for _ in range(count):
        if following:
            code = bits.number()
            change = (code + 1) // 2 if code % 2 else -(code // 2)
            following = (last + change) % 256
        last = following or last
