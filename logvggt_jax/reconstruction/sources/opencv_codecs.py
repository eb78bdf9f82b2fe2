"""Which codecs OpenCV alone reads with the checks that PyAV allows, and what their packets are like."""

from __future__ import annotations

from typing import NamedTuple

import cv2

VP9 = b"vp90"
WITHOUT_HEADER = (b"mjpg", b"gif ")
"""Codecs of which no file says beforehand that they are HDR, or interlaced."""
# A packet of so few bytes stands for no change in codecs that refer to other frames.
_NO_CHANGE = 8


class Codec(NamedTuple):
    """What is known of the packets of a codec.

    Attributes:
      reordered: they may be stored in another order than that in which their frames are shown.
      empty: bytes up to which one shows no frame of its own.
      holds_one: its decoder holds back one frame, and drops it where the size changes.
    """

    reordered: bool = False
    empty: int = 0
    holds_one: bool = False


_REORDERED, _OF_MPEG = Codec(reordered=True, empty=_NO_CHANGE), Codec(True, _NO_CHANGE, holds_one=True)
_AS_SHOWN, _ALONE = Codec(empty=_NO_CHANGE), Codec()
# Of any other codec damage within a picture draws no word, as of VP8 by one thread, or a change of size is not seen.
_CODECS = {
    **dict.fromkeys((b"h264", b"hevc"), _REORDERED),
    **dict.fromkeys((b"mpg1", b"mpg2", b"fmp4"), _OF_MPEG),
    **dict.fromkeys((VP9, b"h263", b"flv1"), _AS_SHOWN),
    **dict.fromkeys((b"mp42", b"mp43", b"wmv1", b"wmv2"), _AS_SHOWN),
    **dict.fromkeys((b"mjpg", b"mpng", b"avdn", b"gif ", b"rle ", b"\0\0\0\0"), _ALONE),
    **dict.fromkeys((b"hfyu", b"ffvh", b"ffv1"), _ALONE),
}
# What the codecs are called in some files, and by some builds of OpenCV.
_OTHER_NAMES = {
    b"avc1": b"h264",
    **dict.fromkeys((b"hvc1", b"hev1"), b"hevc"),
    **dict.fromkeys((b"mp4v", b"xvid", b"divx", b"dx50"), b"fmp4"),
}


def codec_name(capture: cv2.VideoCapture) -> bytes:
    """Of an open file, four small letters."""
    name = (int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little").lower()
    return _OTHER_NAMES.get(name, name)


def codec_of(name: bytes) -> Codec | None:
    """None for one that OpenCV alone does not read with the checks that PyAV allows."""
    return _CODECS.get(name)
