"""The size of the pictures, as a packet of a video states it by its codec."""

from __future__ import annotations

import io
import re
import struct
import warnings

from PIL import Image

from logvggt_jax.reconstruction.sources.bits import Bits
from logvggt_jax.reconstruction.sources.h264_parameters import SHARED, read_sequence

Size = tuple[int, int]
# Bytes within which parameters end.
_LONGEST = 1 << 10
# Where the parameters of a sequence begin.
_H264 = re.compile(rb"\x00\x00\x01(?=[\x07\x27\x47\x67]...)", re.DOTALL)
_HEVC = re.compile(rb"\x00\x00\x01\x42.", re.DOTALL)
_MPEG = re.compile(rb"\x00\x00\x01\xb3")
_MPEG_EXTENSION = re.compile(rb"\x00\x00\x01\xb5(?=[\x10-\x1f])")
_MPEG4 = re.compile(rb"\x00\x00\x01[\x20-\x2f]")
# Bits of what MPEG-4 tells of the buffer of a decoder.
_BUFFER_BITS = 79
# Sizes (H, W) that H.263 and Sorenson's codec have numbers for.
_H263_SIZES = {1: (96, 128), 2: (144, 176), 3: (288, 352), 4: (576, 704), 5: (1152, 1408)}
_SORENSON_SIZES = {2: (288, 352), 3: (144, 176), 4: (96, 128), 5: (240, 320), 6: (120, 160)}
_H263_EXTENDED, _H263_CUSTOM = 7, 6


def stated_size(packet: bytes, codec: bytes) -> Size | None:
    """(H, W) of the pictures from this packet on, before rotation, by the codec as OpenCV calls it in small letters.

    None where the packet states none, or is damaged.
    """
    stated = _STATED.get(codec)
    size = stated(packet) if stated else None
    return size if size and min(size) > 0 else None


def _behind(packet: bytes, begins: re.Pattern[bytes]) -> bytes:
    found = begins.search(packet)
    return packet[found.end() : found.end() + _LONGEST] if found else b""


def _of_h264(packet: bytes) -> Size | None:
    unit = _behind(packet, _H264)
    return read_sequence(unit).size if unit else None


def _of_hevc(packet: bytes) -> Size | None:
    """ITU-T H.265, 7.3.2.2."""
    bits = Bits.unescaped(_behind(packet, _HEVC))
    bits.take(4)
    layers = bits.take(3)
    bits.take(1 + 96)
    # Of each layer above the first, whether its profile and its level are told.
    told = [(bits.take(1), bits.take(1)) for _ in range(layers)]
    bits.take(2 * (8 - layers) if layers else 0)
    for profile, level in told:
        bits.take(88 * profile + 8 * level)
    bits.number()
    colours = min(bits.number(), 3)
    if colours == 3:
        bits.take(1)
    width, height = bits.number(), bits.number()
    if bits.take(1):
        columns, rows = SHARED[colours]
        width -= columns * (bits.number() + bits.number())
        height -= rows * (bits.number() + bits.number())
    return height, width


def _of_mpeg(packet: bytes) -> Size:
    """ISO/IEC 13818-2, 6.2.2.1 and, of large pictures of MPEG-2, 6.2.2.3."""
    bits, more = Bits(_behind(packet, _MPEG)), Bits(_behind(packet, _MPEG_EXTENSION))
    width, height = bits.take(12), bits.take(12)
    more.take(15)
    width |= more.take(2) << 12
    height |= more.take(2) << 12
    return height, width


def _of_mpeg4(packet: bytes) -> Size | None:
    """ISO/IEC 14496-2, 6.2.3."""
    bits = Bits(_behind(packet, _MPEG4))
    bits.take(9)
    version = 1
    if bits.take(1):
        version = bits.take(4)
        bits.take(3)
    if bits.take(4) == 15:
        bits.take(16)
    if bits.take(1):
        bits.take(3)
        if bits.take(1):
            bits.take(_BUFFER_BITS)
    shape = bits.take(2)
    if shape == 3 and version != 1:
        bits.take(4)
    bits.take(1)
    resolution = bits.take(16)
    bits.take(1)
    if bits.take(1):
        bits.take(max(1, (resolution - 1).bit_length()))
    if shape or not resolution:
        return None
    bits.take(1)
    width = bits.take(13)
    bits.take(1)
    return bits.take(13), width


def _of_h263(packet: bytes) -> Size | None:
    """ITU-T H.263, 5.1."""
    bits = Bits(packet[:16])
    if bits.take(22) != 0x20:
        return None
    bits.take(8 + 5)
    form = bits.take(3)
    if form == _H263_EXTENDED and bits.take(3) == 1:
        form = bits.take(3)
        bits.take(15 + 9)
        if bits.take(1):
            bits.take(2)
        if form == _H263_CUSTOM:
            bits.take(4)
            width = 4 * (bits.take(9) + 1)
            bits.take(1)
            return 4 * bits.take(9), width
    return _H263_SIZES.get(form)


def _of_sorenson(packet: bytes) -> Size | None:
    """Adobe's Video File Format Specification 10, H.263 video packet."""
    bits = Bits(packet[:16])
    if bits.take(17) != 1:
        return None
    bits.take(5 + 8)
    form = bits.take(3)
    if form < 2:
        width = bits.take(8 * (form + 1))
        return bits.take(8 * (form + 1)), width
    return _SORENSON_SIZES.get(form)


def _of_picture(packet: bytes) -> Size | None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd camera data
            with Image.open(io.BytesIO(packet)) as picture:
                return picture.height, picture.width
    except (OSError, ValueError):
        return None


def _of_dnxhd(packet: bytes) -> Size | None:
    """SMPTE ST 2019-1, 7.2."""
    return struct.unpack_from(">HH", packet, 24) if len(packet) > 28 and packet[:2] == b"\0\0" else None


_STATED = {
    b"h264": _of_h264,
    b"hevc": _of_hevc,
    b"mpg1": _of_mpeg,
    b"mpg2": _of_mpeg,
    b"fmp4": _of_mpeg4,
    b"h263": _of_h263,
    b"flv1": _of_sorenson,
    b"mjpg": _of_picture,
    b"mpng": _of_picture,
    b"avdn": _of_dnxhd,
}
