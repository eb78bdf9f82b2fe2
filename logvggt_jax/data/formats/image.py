"""Pictures from files, with the damage that decoders let pass reported.

OpenCV decodes truncated JPEG and PNG files without complaint and fills the missing part with grey; files are
therefore walked to their end marker first. Where this walk does not find a JPEG regular, or its end might be what the
decoder made up, Pillow decides whether it is whole (`jpeg.py`), which takes half as long again.
"""

import io
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from PIL import TiffImagePlugin

from logvggt_jax.data.errors import BrokenPicture, missing_file
from logvggt_jax.data.formats.file_kinds import SIGNATURE_BYTES, kind_of
from logvggt_jax.data.formats.jpeg import JPEG_START, LOST, decode_jpeg, ends_flat
from logvggt_jax.data.formats.tiff import misread
from logvggt_jax.errors import InputError, one_line

PNG_START = b"\x89PNG\r\n\x1a\n"
# Within entropy-coded data a real marker is FF followed by neither 00, a restart marker nor a fill byte.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_JPEG_END, _JPEG_SCAN, _JPEG_PROGRESSIVE = 0xD9, 0xDA, 0xC2
_TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_ORIENTATION = 0x112
_DECODED = ("JPEG", "PNG", "WebP", "TIFF", "BMP", "GIF picture", "JPEG 2000 picture")


def read_rgb(path: str | Path) -> np.ndarray:
    """Colour picture [H, W, 3] uint8 RGB; grey is repeated, alpha is composited over white, of 16 bits a channel
    (PNG, TIFF) the upper 8 are taken.

    Orientation tags are ignored: calibrations belong to the pixels as stored. Raises MissingFiles, or InputError naming
    the file: truncated, damaged or undecodable, of another type, or a depth map by its values.
    """
    path = Path(path)
    data = _content(path)
    picture = _decode(path, data)
    if picture.dtype == np.uint16 and data.startswith((PNG_START, *_TIFF_ORDERS)):
        if fault := _misread_tiff(data):
            raise BrokenPicture(f"{path}: a TIFF of {fault}, which is not read: convert it to PNG")
        if looks_like_depth(picture):
            raise BrokenPicture(
                f"{path}: expected colour, got grey with 16 bits whose values (up to {picture.max()}) look like depth: "
                "put a colour picture in its place, or, if this is one, convert it to 8 bits"
            )
        picture = (picture >> 8).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise BrokenPicture(f"{path}: expected 8-bit colour, got {picture.dtype}: convert it to 8 bits a channel")
    if picture.ndim == 2:
        return np.repeat(picture[:, :, None], 3, axis=2)
    if picture.shape[2] == 4:
        picture = over_white(picture)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def over_white(picture: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] uint8 of a picture [H, W, 4] uint8 with alpha on a white ground.

    Of screenshots and of what game engines render alpha is often 0 throughout, and meant by nobody: it is left out,
    unless there is nothing to be seen below it.
    """
    if not picture[..., 3].any() and picture[..., :3].min() < picture[..., :3].max():
        return picture[..., :3].copy()
    alpha = picture[:, :, 3:].astype(np.float32) / 255.0
    return (picture[:, :, :3] * alpha + 255.0 * (1.0 - alpha) + 0.5).astype(np.uint8)


def read_depth(path: str | Path) -> np.ndarray:
    """16-bit single-channel picture [H, W] uint16, in the file's own unit.

    Raises MissingFiles, or InputError naming the file: truncated, damaged or undecodable, or not 16-bit with one
    channel.
    """
    path = Path(path)
    picture = _decode(path, _content(path))
    if picture.dtype != np.uint16 or picture.ndim != 2:
        raise BrokenPicture(
            f"{path}: expected 16-bit depth with one channel, got {picture.dtype} with shape {picture.shape}: "
            "replace it with the data set's original file"
        )
    return picture


def looks_like_depth(values: np.ndarray) -> bool:
    """Whether the pixels of a picture [H, W] or [H, W, C] uint16 are grey and look like those of a depth map.

    Depth maps have values for distances in millimetres or similar: none near white, or pixels without a value (0)
    and between them and the nearest distance nothing. Grey levels that come from 8 bits are no distances.
    """
    if values.ndim > 2 or not values.any() or any((values % step == 0).all() for step in (256, 257)):
        return False
    none, near_none = np.mean(values == 0), np.mean((values > 0) & (values < 256))
    dark = values[values < 65535].max(initial=0) < 1 << 14
    return bool(dark or (none > 0.01 and near_none < 0.001 * none))


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


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise missing_file(path)
    return path.read_bytes()


def _decode(path: Path, data: bytes) -> np.ndarray:
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
        raise BrokenPicture(f"{path}: {_not_decoded(data)}")
    if data.startswith(JPEG_START) and ends_flat(picture):
        with decoding_errors(path):
            decode_jpeg(data)
    return picture


def _not_decoded(data: bytes) -> str:
    """What lies in the place of a picture, and the mend."""
    kind = kind_of(data[:SIGNATURE_BYTES])
    if kind in ("HEIC", "AVIF"):
        return f"{kind} inside: convert it to JPEG"
    if kind in _DECODED:
        return f"damaged, or a {kind} of a kind that OpenCV does not decode: fetch it again, or convert it to PNG"
    return f"no picture but a {kind}: fetch it again" if kind else "no picture: fetch it again"


def _misread_tiff(data: bytes) -> str | None:
    """See `misread`; None for other formats, too."""
    if data[:4] not in _TIFF_ORDERS:
        return None
    stream = io.BytesIO(data)
    tags = TiffImagePlugin.ImageFileDirectory_v2(stream.read(8))
    stream.seek(tags.next)
    tags.load(stream)
    return misread(tags)


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
    """Whether the segments up to the end-of-image marker are all there and nothing else (ITU T.81, annex B).

    A progressive picture counts as irregular: without its last scans it is coarse throughout, and ends like any other.
    So does one of which a part may be lost.
    """
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
        if kind == _JPEG_PROGRESSIVE:
            return False
        if position + 4 > len(data):
            return False
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if kind == _JPEG_SCAN:
            marker = _JPEG_MARKER.search(data, position)
            if marker is None or data.find(LOST, position, marker.start()) >= 0:
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
