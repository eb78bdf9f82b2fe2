"""The boxes that a file of the ISO base media format (mp4, mov, AVIF, HEIC) is made of."""

from collections.abc import Iterator
from typing import IO, NamedTuple


class Box(NamedTuple):
    """A box of the outermost level.

    Attributes:
      kind: four bytes, such as b"moov".
      end: the position after it by its own length, which may lie beyond the end of the file.
    """

    kind: bytes
    end: int


def boxes(stream: IO[bytes], size: int) -> Iterator[Box]:
    """The boxes of a file of `size` bytes, in order.

    One whose length cannot be, which is less than its head takes, ends one byte beyond the file and is the last.
    """
    position = 0
    while position + 8 <= size:
        stream.seek(position)
        head = stream.read(16)
        length = int.from_bytes(head[:4], "big")
        if length == 1:  # a longer number follows the kind
            length = int.from_bytes(head[8:], "big")
        if length == 0:  # to the end of the file
            length = size - position
        position = position + length if length >= 8 else size + 1
        yield Box(head[4:8], position)
