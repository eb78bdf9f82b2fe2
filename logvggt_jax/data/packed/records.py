"""One frame as the bytes of a record; exactly the values that went in come out."""

import struct

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames

_HEADER = struct.Struct("<cII")
_FRAME, _BROKEN = b"F", b"E"
_CAMERA = 3 * 3 + 4 * 4


def frame_record(frames: Frames) -> bytes:
    """The record of one frame, `Frames` with T = 1."""
    height, width = frames.images.shape[1:3]
    camera = np.concatenate([frames.intrinsics.ravel(), frames.extrinsics.ravel()]).astype("<f4")
    # Differences of rows, modulo 256, compress to little more than half of the picture's own bytes.
    picture = frames.images[0].copy()
    picture[1:] -= frames.images[0, :-1]
    depth = frames.depth[0].astype("<f4")
    return _HEADER.pack(_FRAME, height, width) + camera.tobytes() + picture.tobytes() + depth.tobytes()


def broken_record(message: str) -> bytes:
    """The record of a frame that cannot be read: reading it fails with the same message."""
    return _HEADER.pack(_BROKEN, 0, 0) + message.encode(errors="surrogateescape")


def read_record(record: bytes, *, metric: bool) -> Frames:
    """The frame of a record; InputError with the message of one that could not be read, ValueError for other bytes."""
    kind, height, width = _HEADER.unpack_from(record)
    if kind == _BROKEN:
        raise InputError(record[_HEADER.size :].decode(errors="surrogateescape"))
    camera_end = _HEADER.size + 4 * _CAMERA
    picture_end = camera_end + 3 * height * width
    if kind != _FRAME or len(record) != picture_end + 4 * height * width:
        raise ValueError(f"a record of kind {kind!r} with {len(record)} bytes")
    camera = np.frombuffer(record, "<f4", _CAMERA, _HEADER.size).astype(np.float32)
    rows = np.frombuffer(record, np.uint8, picture_end - camera_end, camera_end).reshape(height, width, 3)
    depth = np.frombuffer(record, "<f4", height * width, picture_end).astype(np.float32)
    return Frames(
        images=np.add.accumulate(rows, axis=0, dtype=np.uint8)[None],
        depth=depth.reshape(1, height, width),
        intrinsics=camera[:9].reshape(1, 3, 3),
        extrinsics=camera[9:].reshape(1, 4, 4),
        metric=metric,
    )
