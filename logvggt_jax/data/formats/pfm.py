"""Portable float maps: depth as 32-bit floats behind three lines of text."""

import re
from pathlib import Path

import numpy as np

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.source_files import read_regular

# One white space ends the header; what follows belongs to the numbers.
_HEADER = re.compile(rb"(P[fF])\s+(\d{1,9})\s+(\d{1,9})\s+([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s")


def read_pfm(path: str | Path) -> np.ndarray:
    """Float map [H, W] float32, top row first (files hold the bottom row first).

    A negative scale in the header means little-endian numbers; its size is no unit and is ignored. Raises MissingFiles,
    or InputError naming the file: no header of a single-channel map, or another number of bytes than it promises.
    """
    data = read_regular(path)
    header = _HEADER.match(data)
    if header is None or header[1] != b"Pf":
        raise BrokenPicture(
            f"{path}: expected a single-channel float map ('Pf', width, height, scale), got {data[:16]!r}: "
            "fetch it again"
        )
    width, height = int(header[2]), int(header[3])
    expected, found = 4 * width * height, len(data) - header.end()
    if found != expected or not expected:
        raise BrokenPicture(
            f"{path}: a float map of {width} x {height} has {expected} bytes after its header, got {found}: "
            "fetch it again"
        )
    numbers = np.frombuffer(data, "<f4" if float(header[4]) < 0 else ">f4", offset=header.end())
    return numbers.reshape(height, width)[::-1].astype(np.float32)
