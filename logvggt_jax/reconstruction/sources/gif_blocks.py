"""The blocks that a GIF is made of."""

from typing import IO


def breaks_off(stream: IO[bytes]) -> bool:
    """Whether a GIF ends, or is damaged, before the block that marks its end."""
    stream.seek(10)
    if not (flags := stream.read(1)):
        return True
    stream.seek(2 + _table_size(flags[0]), 1)
    while kind := stream.read(1):
        if kind == b";":
            return False
        if kind == b",":  # a picture: its place, colours, and the size of a code
            if len(place := stream.read(9)) < 9:
                return True
            stream.seek(_table_size(place[8]) + 1, 1)
        elif kind == b"!":  # an extension, of a kind
            stream.seek(1, 1)
        elif kind == b"\0":  # some programs end blocks twice
            continue
        else:
            return True
        while (length := stream.read(1)) not in (b"", b"\0"):
            stream.seek(length[0], 1)
    return True


def _table_size(flags: int) -> int:
    """Bytes of the colours that follow, by the flags before them."""
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0
