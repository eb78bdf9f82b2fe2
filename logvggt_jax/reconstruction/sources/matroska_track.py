"""What a Matroska or WebM file says (RFC 9559): where it ends, and how pictures of its first video are to be shown."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import IO

import numpy as np

from logvggt_jax.reconstruction.sources.mp4_track import TrackView

_START, _SEGMENT, _CLUSTER = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75"
# Bytes within which tracks are described.
_HEAD = 1 << 20
# The element Projection, short enough for a length of one byte.
_PROJECTION = re.compile(rb"\x76\x70([\x80-\xfe])")
_TYPE, _YAW, _PITCH, _ROLL = b"\x76\x71", b"\x76\x73", b"\x76\x74", b"\x76\x75"
_TYPES = {1: "equirectangular", 2: "a cube map", 3: "a mesh"}
_FLOATS = {4: ">f", 8: ">d"}
# A track's own number, where it is described and where something is said of it; and a track's kind.
_TRACK, _OF_TRACK = re.compile(rb"\x73\xc5([\x81-\x88])"), re.compile(rb"\x63\xc5([\x81-\x88])")
_KIND, _VIDEO = b"\x83\x81", b"\1"
# How long a track is, as is said of it, behind its number in so many bytes; and how long the file is, in milliseconds
# but where another unit is stated.
_TAG, _TAG_LENGTH = re.compile(rb"DURATION\x44\x87[\x80-\xff](\d+):(\d\d):(\d\d\.\d+)"), 64
_DURATION, _UNIT = re.compile(rb"\x44\x89([\x84\x88])"), re.compile(rb"\x2a\xd7\xb1([\x81-\x88])")
# How long the last frame is shown, behind it and before the index or the end, where it says so itself.
_LAST = re.compile(
    rb"\x9b(?:\x81(.)|\x82(..)|\x83(...)|\x84(....))(?:(?:\xfb|\x75\xa2).{2,9})?(?:\x1c\x53\xbb\x6b|\Z)", re.DOTALL
)
_TAIL = 1 << 16


def lacks_end(stream: IO[bytes]) -> bool:
    """Whether a file is shorter than it says; one that was written without going back does not say."""
    stream.seek(0)
    if stream.read(len(_START)) != _START:
        return False
    stream.seek(_length(stream) or 0, 1)
    if stream.read(len(_SEGMENT)) != _SEGMENT:
        return False
    length = _length(stream)
    return length is not None and stream.tell() + length > stream.seek(0, 2)


def _length(stream: IO[bytes]) -> int | None:
    """The length of an element, whose first bit that is set tells how many bytes it takes; None where it is open."""
    first = stream.read(1) or b"\0"
    more = 8 - first[0].bit_length()
    number = int.from_bytes(first + stream.read(more), "big") - (1 << 7 * (more + 1))
    return None if number == (1 << 7 * (more + 1)) - 1 else max(0, number)


def read_matroska_view(path: Path) -> TrackView | None:
    """None for files of other formats."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
        file.seek(-min(_TAIL, file.seek(0, 2)), 2)
        tail = file.read()
    if not head.startswith(_START):
        return None
    head = head.partition(_CLUSTER)[0]
    seconds = _seconds(head, tail)
    for found in _PROJECTION.finditer(head):
        values = _values(head[found.end() : found.end() + found[1][0] - 0x80])
        if values:
            projection = _TYPES.get(int(values.get(_TYPE, 0)))
            # A pinhole's picture is turned by its roll, and mirrored where it is seen from behind.
            turned = _matrix(values.get(_YAW, 0.0), values.get(_PITCH, 0.0), values.get(_ROLL, 0.0))
            return TrackView(None if projection else turned, projection, seconds)
    return TrackView(seconds=seconds)


def _seconds(head: bytes, tail: bytes) -> float | None:
    """From the file's beginning to the end of the first video, or to the beginning of its last frame where that says
    how long it is shown; None where that is not stated."""
    tracks = list(_TRACK.finditer(head))
    videos = [each for each in tracks if head[each.end() :].partition(_KIND)[2].startswith(_VIDEO)]
    unit = next((_number(head, found) for found in _UNIT.finditer(head)), 1_000_000) / 1e9
    last = _LAST.search(tail)
    shown = unit * int.from_bytes(last[last.lastindex or 0], "big") if last else 0.0
    for found in _OF_TRACK.finditer(head):
        said = _TAG.search(head, found.end(), found.end() + _TAG_LENGTH)
        if said and videos and _number(head, found) == _number(head, videos[0]):
            hours, minutes, seconds = map(float, said.groups())
            return 3600 * hours + 60 * minutes + seconds - shown or None
    duration = _DURATION.search(head)
    if duration is None or len(tracks) != 1:
        return None
    (length,) = struct.unpack_from(_FLOATS[duration[1][0] - 0x80], head.ljust(duration.end() + 8), duration.end())
    return length * unit - shown if math.isfinite(length) and length > 0 else None


def _number(head: bytes, found: re.Match[bytes]) -> int:
    """What follows a name and its length."""
    return int.from_bytes(head[found.end() : found.end() + found[1][0] - 0x80], "big")


def _values(content: bytes) -> dict[bytes, float]:
    """The numbers of the element Projection by the elements' names; none where it is another one, or damaged."""
    values: dict[bytes, float] = {}
    place = 0
    while place + 3 <= len(content):
        # Of a name the first byte tells the length.
        begin = place + (1 if content[place] >= 0x80 else 2)
        name, length = content[place:begin], content[begin] - 0x80
        data = content[begin + 1 : begin + 1 + length]
        if name == _TYPE and length == len(data) == 1:
            values[name] = data[0]
        elif name in (_YAW, _PITCH, _ROLL) and length in _FLOATS and length == len(data):
            (values[name],) = struct.unpack(_FLOATS[length], data)
        elif length < 0:
            return {}
        place = begin + 1 + length
    return values


def _matrix(yaw: float, pitch: float, roll: float) -> np.ndarray | None:
    if pitch or yaw not in (0.0, 180.0, -180.0) or not -360 <= roll <= 360:
        return None
    mirrored = np.diag([-1, 1]) if yaw else np.eye(2, dtype=int)
    matrix = mirrored @ np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), round(roll / 90) % 4)
    return None if np.array_equal(matrix, np.eye(2)) else matrix.astype(np.float64)
