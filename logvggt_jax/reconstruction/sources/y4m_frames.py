"""The frames that a file of YUV4MPEG2 is made of, all of one size."""

import re
from typing import IO

_START, _FRAME = b"YUV4MPEG2 ", b"FRAME"
_LONGEST_LINE = 1 << 10
# How colours are sampled, then where, or how many bits above 8 a value has.
_COLOURS = re.compile(rb"(420|422|444alpha|444|411|mono)(?:p?(\d+)|jpeg|mpeg2|paldv)?\Z")


def is_broken(stream: IO[bytes]) -> bool:
    """Whether a YUV4MPEG2 file is damaged between its frames, or ends within one. Not known of unusual colours."""
    stream.seek(0)
    head = stream.readline(_LONGEST_LINE)
    size = _frame_size(head) if head.startswith(_START) else None
    if size is None:
        return False
    end = stream.seek(0, 2)
    place = len(head)
    while place < end:
        stream.seek(place)
        line = stream.readline(_LONGEST_LINE)
        place += len(line) + size
        if not line.startswith(_FRAME) or not line.endswith(b"\n") or place > end:
            return True
    return False


def _frame_size(head: bytes) -> int | None:
    """Bytes of a frame by the first line."""
    words = {word[:1]: word[1:] for word in head.split()[1:]}
    found = _COLOURS.match(words.get(b"C", b"420jpeg"))
    if found is None or not words.get(b"W", b"").isdigit() or not words.get(b"H", b"").isdigit():
        return None
    width, height = int(words[b"W"]), int(words[b"H"])
    across, down = {b"420": (2, 2), b"422": (2, 1), b"411": (4, 1)}.get(found[1], (1, 1))
    of_colour = -(-width // across) * -(-height // down)
    planes = {b"mono": 0, b"444alpha": 3}.get(found[1], 2)
    return (width * height + planes * of_colour) * (2 if found[2] else 1)
