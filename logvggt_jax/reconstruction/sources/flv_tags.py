"""The tags that an FLV file is made of."""

from typing import IO

_START = b"FLV\x01"
# Audio, video, and what a script is to know.
_KINDS = (8, 9, 18)
_HEAD, _LENGTH_BEFORE = 11, 4


def another_follows(stream: IO[bytes]) -> bool:
    """Whether behind the last tag of an FLV file another file of that kind begins, which FFmpeg does not read."""
    stream.seek(0)
    head = stream.read(9)
    if not head.startswith(_START):
        return False
    stream.seek(int.from_bytes(head[5:], "big") + _LENGTH_BEFORE)
    while (tag := stream.read(_HEAD)) and tag[0] & 0x1F in _KINDS:
        stream.seek(int.from_bytes(tag[1:4], "big") + _LENGTH_BEFORE, 1)
    return tag.startswith(_START)
