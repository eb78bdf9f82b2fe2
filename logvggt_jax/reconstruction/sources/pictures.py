"""Pictures of all formats as upright 8-bit colours; what a file is says its content, not its name."""

from __future__ import annotations

import io
from pathlib import Path
from types import MappingProxyType
from typing import IO

import numpy as np
from PIL import (
    AvifImagePlugin,
    BmpImagePlugin,
    Image,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.file_kinds import SIGNATURE_BYTES, kind_of
from logvggt_jax.data.formats.image import decoding_errors, looks_like_depth, over_white, png_is_whole
from logvggt_jax.data.formats.jpeg import decode_jpeg
from logvggt_jax.data.formats.tiff import misread
from logvggt_jax.errors import InputError, MissingPackage, disk_errors, one_line

IMAGE_SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif"),
    *(".png", ".webp", ".tif", ".tiff", ".bmp"),
    *(".heic", ".heif", ".hif", ".avif"),
)
MOST_PIXELS = 2 * (Image.MAX_IMAGE_PIXELS or 89_478_485)

# Plugins by name, rather than Image.open: that looks at suffixes and warns of sizes which MOST_PIXELS allows.
_READERS: MappingProxyType[str, type[ImageFile.ImageFile]] = MappingProxyType(
    {
        "JPEG": JpegImagePlugin.JpegImageFile,
        "PNG": PngImagePlugin.PngImageFile,
        "WebP": WebPImagePlugin.WebPImageFile,
        "TIFF": TiffImagePlugin.TiffImageFile,
        "BMP": BmpImagePlugin.BmpImageFile,
        "AVIF": AvifImagePlugin.AvifImageFile,
    }
)
# Formats that keep every level as it was, as a rule.
_EXACT = ("PNG", "BMP", "TIFF")
# As ImageOps.exif_transpose: what turns the stored pixels upright, by EXIF orientation.
_UPRIGHT = MappingProxyType(
    {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_270,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_90,
    }
)


def read_picture(path: Path, *, orientation: int = 1) -> np.ndarray:
    """The pixels [H, W, 3] uint8 RGB, turned upright by the EXIF orientation that the header gave.

    Grey is repeated, alpha composited over white unless it is 0 throughout a picture of several colours, 16 bits a
    channel become the upper 8, CMYK is converted.

    Raises:
      BrokenPicture: truncated, damaged or no picture.
      InputError: pixels that are no colours, as those of depth maps in floating point.
      MissingPackage: HEIC without pillow-heif.
    """
    with disk_errors(path):
        data = path.read_bytes()
    picture = _decode(path, data)
    if orientation in _UPRIGHT:
        with decoding_errors(path):
            picture = picture.transpose(_UPRIGHT[orientation])
    return _colours(path, picture)


def read_not_black(path: Path, *, orientation: int = 1) -> np.ndarray:
    """Where a picture is neither black nor transparent, bool [H, W], turned upright by the EXIF orientation.

    Black is 0 in all channels; in formats that lose detail what is darker than half in all. Errors as `read_picture`.
    """
    with disk_errors(path):
        data = path.read_bytes()
    picture = _decode(path, data)
    least = 1 if kind_of(data[:SIGNATURE_BYTES]) in _EXACT else 128
    with decoding_errors(path):
        if picture.mode.startswith("I;16"):
            return upright(np.asarray(picture) > 0, orientation)
        levels = np.asarray(picture.convert("RGBA"))
    visible: np.ndarray = (levels[..., :3].max(-1) >= least) & (levels[..., 3] > 0)
    return upright(visible, orientation)


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels [H, W], turned as `read_picture` turns those of a picture."""
    if orientation not in _UPRIGHT:
        return pixels
    levels = Image.fromarray(pixels.astype(np.uint8))
    return np.array(levels.transpose(_UPRIGHT[orientation])).astype(pixels.dtype)


def refuse_depth(path: Path) -> None:
    """Raises InputError for a grey picture with 16 bits that looks like a depth map."""
    with disk_errors(path):
        values = np.asarray(_decode(path, path.read_bytes()))
    if looks_like_depth(values):
        raise InputError(
            f"{path}: a grey picture with 16 bits whose values (up to {values.max()}) look like a depth map; give "
            "colour pictures, choose them with --pattern, or, if these are pictures, convert them to 8 bits"
        )


def open_picture(path: Path, stream: IO[bytes]) -> tuple[str, ImageFile.ImageFile]:
    """The format's name and the picture whose header has been read. Errors as `read_picture`."""
    stream.seek(0)
    start = stream.read(SIGNATURE_BYTES)
    kind = kind_of(start)
    stream.seek(0)
    if not start:
        raise BrokenPicture(f"{path}: empty file (0 bytes): fetch it again")
    if kind == "HEIC":
        reader = _heic_reader(path)
    elif kind in _READERS:
        reader = _READERS[kind]
    else:
        found = f"a {kind}" if kind else f"no picture (it begins with {start[:8]!r})"
        raise BrokenPicture(f"{path} is {found}: expected JPEG, PNG, WebP, TIFF, BMP, AVIF or HEIC")
    with decoding_errors(path):
        try:
            picture = reader(stream)
        except (SyntaxError, KeyError) as error:
            if kind == "TIFF" and _is_floating_point(stream):
                raise not_colours(path, "floating point") from error
            reason = f"unknown or missing: {error}" if isinstance(error, KeyError) else one_line(error)
            raise BrokenPicture(
                f"{path}: damaged, or a {kind} of a kind that is not read ({reason}): fetch it again, or convert it"
            ) from error
    if isinstance(picture, TiffImagePlugin.TiffImageFile) and (fault := misread(picture.tag_v2)):
        raise InputError(f"{path}: a TIFF of {fault}, which is not read: convert it to PNG")
    return kind, picture


def not_colours(path: Path, values: str) -> InputError:
    """The error for a picture whose pixels are of this type."""
    return InputError(
        f"{path}: its pixels are {values}, as those of a depth map: give colour pictures, choose them with --pattern"
    )


def _decode(path: Path, data: bytes) -> Image.Image:
    """The picture with its pixels as stored."""
    if kind_of(data[:SIGNATURE_BYTES]) == "JPEG":
        with decoding_errors(path):
            return decode_jpeg(data)
    kind, picture = open_picture(path, io.BytesIO(data))
    with decoding_errors(path):
        if kind == "PNG" and not png_is_whole(data):
            # Pillow looks at no checksum of the pixels.
            raise BrokenPicture(f"{path}: truncated or damaged picture (wrong checksum): fetch it again")
        picture.load()
        return picture


def _colours(path: Path, picture: Image.Image) -> np.ndarray:
    if picture.mode.startswith("I;16"):
        grey = (np.asarray(picture) >> 8).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    if picture.mode in ("I", "F"):
        raise not_colours(path, "floating point" if picture.mode == "F" else "32-bit numbers")
    with decoding_errors(path):
        if picture.mode == "RGB" and "transparency" not in picture.info:
            return np.array(picture)
        if picture.has_transparency_data:
            return over_white(np.array(picture.convert("RGBA")))
        return np.array(picture.convert("RGB"))


def _heic_reader(path: Path) -> type[ImageFile.ImageFile]:
    try:
        from pillow_heif.as_plugin import HeifImageFile
    except ImportError as error:
        raise MissingPackage(f"{path} is HEIC: install logvggt-jax[heic], or convert it to JPEG") from error
    return HeifImageFile


def _is_floating_point(stream: IO[bytes]) -> bool:
    """Whether a TIFF says so of its samples."""
    stream.seek(0)
    directory = TiffImagePlugin.ImageFileDirectory_v2(stream.read(8))
    stream.seek(directory.next)
    directory.load(stream)
    return 3 in directory.get(TiffImagePlugin.SAMPLEFORMAT, ())
