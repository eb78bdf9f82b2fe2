"""How the pictures of an mp4 or mov file are to be shown, as its video track says."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.reconstruction.sources.media_boxes import boxes

# Bytes of an index beyond which it is left unread; that of ten hours takes less.
_LARGEST_INDEX = 1 << 28
# Where the matrix stands in a track's header, by the header's version.
_MATRIX_AT = {0: 40, 1: 52}
# Boxes of spherical videos, version 2, and what version 1 writes into its XML.
_PROJECTIONS = {b"equi": "equirectangular", b"cbmp": "a cube map", b"mshp": "a mesh"}


class TrackView(NamedTuple):
    """What the first video track says.

    Attributes:
      matrix: see `orientation`; None where nothing is turned.
      projection: of a view all around; None for that of a pinhole camera.
      seconds: that are shown, of Matroska from the beginning of the file; None where the track does not say.
      edited: not all of the track is shown.
    """

    matrix: np.ndarray | None = None
    projection: str | None = None
    seconds: float | None = None
    edited: bool = False


def read_mp4_view(path: Path) -> TrackView:
    """Of files of other formats, nothing."""
    inside = list(_children(_index(path)))
    movie = next((content for kind, content in inside if kind == b"mvhd"), b"")
    for kind, content in inside:
        if kind == b"trak" and (view := _view(content, movie)):
            # Of a file in fragments the index knows the first alone.
            return view._replace(seconds=None) if any(kind == b"mvex" for kind, _ in inside) else view
    return TrackView()


def _index(path: Path) -> bytes:
    """The content of the box `moov`; empty where there is none."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8)[4:] not in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
            return b""
        start = 0
        for box in boxes(file, size):
            if box.kind == b"moov" and box.end - start <= _LARGEST_INDEX:
                file.seek(start)
                return next((content for _, content in _children(file.read(box.end - start))), b"")
            start = box.end
    return b""


def _children(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the boxes in a box."""
    start = 0
    for box in boxes(io.BytesIO(content), len(content)):
        head = 16 if content[start : start + 4] == b"\0\0\0\1" else 8
        yield box.kind, content[start + head : box.end]
        start = box.end


def _view(track: bytes, movie: bytes) -> TrackView | None:
    """None for a track that is no video; `movie` is the content of `mvhd`."""
    inside = dict(_children(track))
    media = dict(_children(inside.get(b"mdia", b"")))
    if media.get(b"hdlr", b"")[8:12] != b"vide":
        return None
    timing = _shown(inside.get(b"edts", b""), media, movie)
    return TrackView(_matrix(inside.get(b"tkhd", b"")), _projection(track), *timing)


def _matrix(header: bytes) -> np.ndarray | None:
    place = _MATRIX_AT.get(header[0] if header else -1)
    numbers = b"" if place is None else header[place : place + 36]
    if len(numbers) < 36:
        return None
    matrix = np.frombuffer(numbers, ">i4").reshape(3, 3)[:2, :2].astype(np.float64)
    upright = not matrix.any() or np.array_equal(matrix, np.eye(2) * matrix[0, 0])
    return None if upright and matrix[0, 0] >= 0 else matrix


def _projection(track: bytes) -> str | None:
    if noted := re.search(rb"ProjectionType>(\w{1,32})<", track):
        return noted[1].decode()
    projection = re.search(rb"proj.{4,64}?(equi|cbmp|mshp)", track, re.DOTALL) if b"sv3d" in track else None
    return projection and _PROJECTIONS[projection[1]]


def _shown(edits: bytes, media: dict[bytes, bytes], movie: bytes) -> tuple[float | None, bool]:
    """Seconds that are shown, and whether the edit list leaves something out."""
    (whole, unit), (_, movie_unit) = _duration(media.get(b"mdhd", b"")), _duration(movie)
    seconds = whole / unit if whole and unit else None
    shown = dict(_children(edits)).get(b"elst", b"")
    if not shown or seconds is None or not movie_unit:
        return seconds, False
    layout = struct.Struct(">Qqi" if shown[0] else ">Iii")
    entries = [each[:2] for each in layout.iter_unpack(shown[8 : 8 + (len(shown) - 8) // layout.size * layout.size])]
    # An entry that begins at -1 is a pause.
    parts = [(length / movie_unit, begin) for length, begin in entries if begin >= 0]
    if not parts or not sum(length for length, _ in parts):  # of a file in fragments, what is shown stands in none
        return seconds, False
    end, begin = parts[0][0] + parts[0][1] / unit, parts[0][1]
    if len(parts) == 1 and end >= seconds - 2 / movie_unit and begin <= _first_offset(media):
        return seconds, False
    return sum(length for length, _ in parts), True


def _first_offset(media: dict[bytes, bytes]) -> int:
    """How much later than it is decoded the first frame is shown: of a stream with references in both directions."""
    table = dict(_children(dict(_children(media.get(b"minf", b""))).get(b"stbl", b""))).get(b"ctts", b"")
    return int.from_bytes(table[12:16], "big", signed=table[:1] == b"\1")


def _duration(header: bytes) -> tuple[int, int]:
    """Duration and units of it in a second, of the content of `mdhd` or `mvhd`; zeros where it is damaged."""
    layout, place = (struct.Struct(">IQ"), 20) if header[:1] == b"\1" else (struct.Struct(">II"), 12)
    if len(header) < place + layout.size:
        return 0, 0
    unit, duration = layout.unpack_from(header, place)
    return duration, unit
