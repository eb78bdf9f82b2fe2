"""A small TIFF whose tags are chosen one by one, for what no library writes."""

import struct
from collections.abc import Mapping
from pathlib import Path

# 6 x 5 pixels of grey in 16 bits, uncompressed, in one strip behind byte 200.
_TAGS = {256: 6, 257: 5, 258: 16, 259: 1, 262: 1, 273: 200, 277: 1, 278: 5, 279: 60, 284: 1}


def write_tiff(path: Path, changed: Mapping[int, int]) -> Path:
    """Writes 16-bit grey with some tags `changed`; there are bytes enough for three channels."""
    tags = _TAGS | dict(changed)
    entries = b"".join(struct.pack("<HHII", name, 4, 1, content) for name, content in tags.items())
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries
    path.write_bytes(head.ljust(200, b"\0") + bytes(range(180)))
    return path
