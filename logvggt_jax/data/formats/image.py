"""Pictures from files, with the damage that decoders let pass reported.

OpenCV decodes truncated JPEG and PNG files without complaint and fills the missing part with grey; files are
therefore walked to their end marker first. A JPEG that this walk does not find regular may still be whole: Pillow
decides (`jpeg.py`), which takes half as long again.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from logvggt_jax.data.errors import BrokenPicture, missing_file
from logvggt_jax.data.formats.jpeg import JPEG_START, decode_jpeg
from logvggt_jax.errors import InputError, one_line

PNG_START = b"\x89PNG\r\n\x1a\n"
# Within entropy-coded data a real marker is FF followed by neither 00, a restart marker nor a fill byte.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_JPEG_END, _JPEG_SCAN = 0xD9, 0xDA
_TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_ORIENTATION = 0x112


def read_rgb(path: str | Path) -> np.ndarray:
    """8-bit colour picture [H, W, 3] uint8 RGB; grey is repeated, alpha is composited over white.

    Orientation tags are ignored: calibrations belong to the pixels as stored. Raises MissingFiles, or InputError naming
    the file: truncated, damaged or undecodable, or not 8 bits a channel.
    """
    picture = _decode(Path(path))
    if picture.dtype != np.uint8:
        raise BrokenPicture(f"{path}: expected 8-bit colour, got {picture.dtype}: convert it to 8 bits a channel")
    if picture.ndim == 2:
        return np.repeat(picture[:, :, None], 3, axis=2)
    if picture.shape[2] == 4:
        picture = over_white(picture)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def over_white(picture: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] uint8 of a picture [H, W, 4] uint8 with alpha on a white ground."""
    alpha = picture[:, :, 3:].astype(np.float32) / 255.0
    return (picture[:, :, :3] * alpha + 255.0 * (1.0 - alpha) + 0.5).astype(np.uint8)


def read_depth(path: str | Path) -> np.ndarray:
    """16-bit single-channel picture [H, W] uint16, in the file's own unit.

    Raises MissingFiles, or InputError naming the file: truncated, damaged or undecodable, or not 16-bit with one
    channel.
    """
    picture = _decode(Path(path))
    if picture.dtype != np.uint16 or picture.ndim != 2:
        raise BrokenPicture(
            f"{path}: expected 16-bit depth with one channel, got {picture.dtype} with shape {picture.shape}: "
            "replace it with the data set's original file"
        )
    return picture


@contextmanager
def decoding_errors(path: Path) -> Iterator[None]:
    """Turns what Pillow raises over a damaged file into BrokenPicture; the system's errors pass through."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # the plugins raise whatever their parsing stumbles over
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise BrokenPicture(f"{path}: truncated or damaged picture ({one_line(error)}): fetch it again") from error


def _decode(path: Path) -> np.ndarray:
    if not path.is_file():
        raise missing_file(path)
    data = path.read_bytes()
    if data.startswith(JPEG_START) and not _jpeg_is_regular(data):
        with decoding_errors(path):
            return np.array(decode_jpeg(data).convert("RGB"))[..., ::-1]
    if not data or (data.startswith(PNG_START) and not png_is_whole(data)):
        raise BrokenPicture(f"{path}: truncated or damaged picture of {len(data)} bytes: fetch it again")
    try:
        picture = cv2.imdecode(np.frombuffer(_as_stored(data), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise BrokenPicture(f"{path}: not a picture that OpenCV can decode ({error.err}): fetch it again") from error
    if picture is None:
        raise BrokenPicture(f"{path}: not a picture that OpenCV can decode: fetch it again")
    return picture


def _as_stored(data: bytes) -> bytes | bytearray:
    """A TIFF file that says that its rows are in order: OpenCV turns those that say otherwise, and no other format."""
    order = _TIFF_ORDERS.get(data[:4])
    if order is None:
        return data
    content = bytearray(data)
    try:
        (position,) = struct.unpack_from(f"{order}I", content, 4)
        (count,) = struct.unpack_from(f"{order}H", content, position)
        for entry in range(position + 2, position + 2 + 12 * count, 12):
            if struct.unpack_from(f"{order}H", content, entry)[0] == _TIFF_ORIENTATION:
                struct.pack_into(f"{order}H", content, entry + 8, 1)
    except struct.error:  # damaged, which the decoder tells
        return data
    return content


def _jpeg_is_regular(data: bytes) -> bool:
    """Whether the segments up to the end-of-image marker are all there and nothing else (ITU T.81, annex B)."""
    position = len(JPEG_START)
    while position + 2 <= len(data):
        if data[position] != 0xFF:
            return False
        kind = data[position + 1]
        if kind == 0xFF:
            position += 1
            continue
        if kind == _JPEG_END:
            return True
        if position + 4 > len(data):
            return False
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if kind == _JPEG_SCAN:
            marker = _JPEG_MARKER.search(data, position)
            if marker is None:
                return False
            position = marker.start()
    return False


def png_is_whole(data: bytes) -> bool:
    """Whether all chunks up to IEND are there with correct checksums (PNG specification, section 5)."""
    position = len(PNG_START)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data) or zlib.crc32(data[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[position + 4 : position + 8] == b"IEND":
            return True
        position = end
    return False
