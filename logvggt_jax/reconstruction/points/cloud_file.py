"""A coloured point cloud on the disk: a binary PLY file, written frame by frame."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.files import atomic_file, open_regular
from logvggt_jax.geometry import unproject_pixels
from logvggt_jax.reconstruction.points.frame_points import FramePoints

_COLOURED = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]

VERTEX = np.dtype([*_COLOURED, ("confidence", "<f4"), ("frame", "<i4")])


# The other one is that of files of earlier versions.
_VERTICES = (VERTEX, np.dtype(_COLOURED))

_PLY_TYPES = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar", np.dtype("<i4"): "int"}


def ply_header(vertex: np.dtype, count: str) -> str:
    """The header of a binary PLY file of so many vertices of this structured dtype."""
    properties = "".join(f"property {_PLY_TYPES[vertex[name]]} {name}\n" for name in vertex.names or ())
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"


class Cloud(NamedTuple):
    """A point cloud as it is stored.

    Attributes:
      points: [M, 3] float32 in the world, all finite.
      colours: [M, 3] uint8 RGB.
      confidence: [M] float32; None in files of versions that did not store it.
      frame: [M] int32, the number of the frame that a point is a pixel of, in rising order; None likewise.
    """

    points: np.ndarray
    colours: np.ndarray
    confidence: np.ndarray | None
    frame: np.ndarray | None


def frame_vertices(
    points: FramePoints, size: tuple[int, int], intrinsics: np.ndarray, extrinsics: np.ndarray, frame: int
) -> np.ndarray:
    """Coloured points [n] of dtype `VERTEX` in the world.

    Args:
      points: [n] of one frame, in the order of its pixels.
      size: (H, W) of the frame.
      intrinsics: [3, 3] in its pixels.
      extrinsics: [3|4, 4] world-to-camera.
      frame: its number.
    """
    depth = np.zeros(size, np.float32)
    depth.reshape(-1)[points.indices] = points.depth
    positions = unproject_pixels(depth[None], intrinsics[None], extrinsics[None], points.indices)
    vertices = np.empty(len(positions), VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = points.colours[:, channel]
    vertices["confidence"], vertices["frame"] = points.confidence, frame
    return vertices


def write_points(path: str | Path, most: int, frames: Iterable[np.ndarray]) -> None:
    """Writes vertices, frame by frame, as a binary PLY file.

    Args:
      path: the PLY file.
      most: number of vertices at most.
      frames: arrays [n] of dtype `VERTEX`; each is written before the next is asked for.

    Raises:
      ValueError: `frames` hold more vertices.
    """
    written = 0
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(ply_header(VERTEX, str(most)).encode())
        for vertices in frames:
            stream.write(vertices.data)
            written += len(vertices)
        if written > most:
            raise ValueError(f"{path}: {most} vertices announced, {written} given")
        stream.seek(0)
        # As long as before: readers skip blanks.
        stream.write(ply_header(VERTEX, str(written).rjust(len(str(most)))).encode())


def count_points(path: str | Path) -> int:
    """The number of vertices of a file that `write_points` has written, read from its header.

    Raises:
      MissingInput: no such file.
      InputError: it is another file, or cut off.
    """
    return len(_stored_points(Path(path)))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] float32, all finite, and colours [M, 3] uint8 of such a file; errors as `count_points`."""
    return read_cloud(path)[:2]


def read_cloud(path: str | Path) -> Cloud:
    """All that such a file holds; errors as `count_points`."""
    vertices = _stored_points(Path(path))
    points = np.stack([vertices[name] for name in "xyz"], axis=-1)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{path} is damaged: {np.count_nonzero(~finite):,} of its {len(points):,} points are not finite; "
            "reconstruct again"
        )
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
    if "frame" not in (vertices.dtype.names or ()):
        return Cloud(points, colours, None, None)
    confidence, frame = np.array(vertices["confidence"]), np.array(vertices["frame"])
    if not np.isfinite(confidence).all() or (np.diff(frame) < 0).any() or (frame[:1] < 0).any():
        raise InputError(f"{path} is damaged: its points' confidences or frames make no sense; reconstruct again")
    return Cloud(points, colours, confidence, frame)


def _stored_points(path: Path) -> np.ndarray:
    """The vertices [M] of a file, mapped and not read."""
    try:
        with open_regular(path) as stream:
            start, found = stream.read(2 * len(ply_header(VERTEX, ""))), os.fstat(stream.fileno()).st_size
            # More digits could not be a size.
            match = re.search(rb"element vertex ( *\d{1,18})\n", start)
            count = int(match[1]) if match else 0
            headers = {each: ply_header(each, match[1].decode()).encode() for each in _VERTICES} if match else {}
            vertex = next((each for each, header in headers.items() if start.startswith(header)), None)
            if vertex is None:
                raise InputError(f"{path} is {_other_file(start)}: expected the output of `logvggt reconstruct`")
            size = len(headers[vertex]) + count * vertex.itemsize
            if found != size:
                raise InputError(
                    f"{path} is {'cut off' if found < size else 'longer than its header says'}: {count:,} points need "
                    f"{size:,} bytes, it has {found:,}; copy it again or reconstruct again"
                )
            return np.memmap(stream, vertex, "r", len(headers[vertex]), (count,)) if count else np.empty(0, vertex)
    except MissingInput:
        raise MissingInput(f"{path} does not exist: expected the output of `logvggt reconstruct`") from None


def _other_file(start: bytes) -> str:
    """What a file is whose first bytes are not those of a cloud of ours."""
    if not start:
        return "empty"
    if not start.startswith(b"ply"):
        return "no PLY file"
    return "cut off in its header" if b"end_header" not in start else "a PLY file of another program, or damaged"
