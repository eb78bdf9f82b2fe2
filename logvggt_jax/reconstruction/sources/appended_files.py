"""Files of a kind of which another follows the first in one file, as `cat` joins them; FFmpeg reads the first alone."""

from typing import IO

_FLV, _ASF = b"FLV\x01", bytes.fromhex("3026b2758e66cf11a6d900aa0062ce6c")
# Of FLV's tags: audio, video, and what a script is to know.
_KINDS = (8, 9, 18)
_TAG_HEAD, _LENGTH_BEFORE = 11, 4
# The part of an ASF file's head that states the file's size, how far behind its name, and bytes within which it stands.
_PROPERTIES, _SIZE_AT, _ASF_HEAD = bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365"), 40, 1 << 16


def another_follows(stream: IO[bytes]) -> bool:
    """Whether behind the end of an FLV or ASF file another one begins."""
    stream.seek(0)
    head = stream.read(_ASF_HEAD)
    if head.startswith(_FLV):
        stream.seek(int.from_bytes(head[5:9], "big") + _LENGTH_BEFORE)
        while (tag := stream.read(_TAG_HEAD)) and tag[0] & 0x1F in _KINDS:
            stream.seek(int.from_bytes(tag[1:4], "big") + _LENGTH_BEFORE, 1)
        return tag.startswith(_FLV)
    if head.startswith(_ASF) and (place := head.find(_PROPERTIES)) >= 0:
        place += _SIZE_AT
        stream.seek(int.from_bytes(head[place : place + 8], "little") & (1 << 62) - 1)
        return stream.tell() > 0 and stream.read(len(_ASF)) == _ASF
    return False
