"""What is known of a picture without its pixels: size, orientation, focal length, and whether its file is whole."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from PIL import ExifTags, Image, ImageFile, TiffImagePlugin

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.image import decoding_errors
from logvggt_jax.data.formats.jpeg import decode_jpeg, first_scan
from logvggt_jax.errors import InputError, disk_errors
from logvggt_jax.reconstruction.sources.media_boxes import boxes
from logvggt_jax.reconstruction.sources.pictures import MOST_PIXELS, not_colours, open_picture

_FILM_DIAGONAL = math.hypot(36, 24)  # mm; what "equivalent to 35 mm film" refers to (CIPA DCG-001)
_RESOLUTION_UNITS = {2: 25.4, 3: 10.0, 4: 1.0}  # mm in the unit of FocalPlaneResolutionUnit
_JPEG_END = b"\xff\xd9"
_MOMENT = re.compile(r"[12]\d{3}:[01]\d:[0-3]\d [0-2]\d:[0-5]\d:[0-6]\d")


@dataclasses.dataclass(frozen=True)
class PictureHeader:
    """What a file says of its picture.

    Attributes:
      size: (H, W) once upright.
      orientation: EXIF orientation, 1 to 8, that is still to be applied to the decoded pixels.
      focal_length: pixels of the picture, from EXIF; None where it says nothing.
      deep_grey: one channel of 16 bits, which may be a depth map.
      pages: pictures in the file; one is read: the first, of HEIC the one that it names.
      panorama: it is said to look all around, equirectangular.
      taken: when by the camera's clock, as `2026:05:01 12:30:59`; None where it does not say.
    """

    size: tuple[int, int]
    orientation: int
    focal_length: float | None
    deep_grey: bool
    pages: int
    panorama: bool
    taken: str | None


def read_header(path: Path) -> PictureHeader:
    """The header of a picture, after a look whether the file reaches to its end.

    Raises:
      BrokenPicture: truncated, damaged or no picture.
      MissingPackage: HEIC without pillow-heif.
      InputError: more pixels than are read, or pixels that are no colours.
      DiskError, MissingInput: the file cannot be read, or is gone.
    """
    with disk_errors(path), path.open("rb") as stream, warnings.catch_warnings():
        # Pillow's remarks on odd metadata; what matters of them is looked at here.
        warnings.simplefilter("ignore")
        kind, picture = open_picture(path, stream)
        width, height = picture.size
        if width * height > MOST_PIXELS:
            raise InputError(
                f"{path} is {width} x {height} pixels ({width * height / 1e6:,.0f} megapixels), more than the "
                f"{MOST_PIXELS / 1e6:.0f} megapixels that are read: make it smaller"
            )
        if picture.mode in ("F", "I"):
            raise not_colours(path, "floating point" if picture.mode == "F" else "32-bit numbers")
        with decoding_errors(path):
            if kind == "PNG":
                # Camera data may follow the pixels; Pillow would decode these to get there.
                _note_exif_of_png(picture, stream)
            exif = _exif(picture)
            # Pillow turns TIFF itself, and its size is the upright one already.
            orientation = 1 if kind == "TIFF" else exif.get(ExifTags.Base.Orientation, 1)
            pages = getattr(picture, "n_frames", 1)
            if not _reaches_end(kind, picture, stream):
                raise BrokenPicture(f"{path}: truncated picture of {_bytes(stream)} bytes: fetch it again")
        sideways = orientation in (5, 6, 7, 8)
        return PictureHeader(
            size=(width, height) if sideways else (height, width),
            orientation=orientation if orientation in range(1, 9) else 1,
            focal_length=_focal_length(exif, width, height),
            deep_grey=picture.mode.startswith("I;16"),
            pages=pages,
            panorama=b"equirectangular" in _xmp(picture),
            taken=_taken(exif),
        )


def _exif(picture: ImageFile.ImageFile) -> Image.Exif:
    """The camera's data; empty where they are damaged, which does not touch the picture."""
    try:
        return Image.Image.getexif(picture)
    except Exception:  # Pillow raises whatever its parsing stumbles over
        return Image.Exif()


def _xmp(picture: ImageFile.ImageFile) -> bytes:
    """What programs note beside EXIF, as XML."""
    xmp = picture.info.get("xmp", picture.info.get("XML:com.adobe.xmp", b""))
    return xmp if isinstance(xmp, bytes) else str(xmp).encode()


def _taken(exif: Image.Exif) -> str | None:
    """The moment that EXIF states; without fractions of a second, which only some cameras write."""
    try:
        moment = str(exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.DateTimeOriginal, ""))
    except Exception:  # as above
        return None
    return moment[:19] if _MOMENT.match(moment) else None


def _focal_length(exif: Image.Exif, width: int, height: int) -> float | None:
    """Focal length in pixels: exactly, where the sensor's resolution is given, else by the equivalent on film."""
    try:
        camera = exif.get_ifd(ExifTags.IFD.Exif)
        length = float(camera.get(ExifTags.Base.FocalLength, 0))
        resolution = float(camera.get(ExifTags.Base.FocalPlaneXResolution, 0))
        unit = _RESOLUTION_UNITS.get(camera.get(ExifTags.Base.FocalPlaneResolutionUnit, 2), 0.0)
        taken_width = float(camera.get(ExifTags.Base.ExifImageWidth, 0))
        equivalent = float(camera.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    except Exception:  # as above
        return None
    candidates = (
        # The longer edge, since programs that turn pictures leave these numbers as they were.
        length * resolution / unit * max(width, height) / taken_width if unit and taken_width else 0.0,
        equivalent / _FILM_DIAGONAL * math.hypot(width, height),
    )
    # Zero and absurd values stand for "unknown".
    return next((f for f in candidates if math.isfinite(f) and 0.1 < f / max(width, height) < 100), None)


def _reaches_end(kind: str, picture: ImageFile.ImageFile, stream: IO[bytes]) -> bool:
    """Whether the file is as long as its own structure says; what pixels say is known with their decoding only."""
    length = _bytes(stream)
    if kind == "JPEG":
        stream.seek(max(0, length - 2))
        if stream.read(2) == _JPEG_END:
            return True
        stream.seek(0)
        data = stream.read()
        # Thumbnails in the header have ends of their own, and among coded pixels FF is never followed by D9.
        if data.find(_JPEG_END, first_scan(data)) < 0:
            decode_jpeg(data)
        return True
    if kind == "PNG":
        return any(chunk == b"IEND" for chunk, _, _ in _png_chunks(stream))
    if kind == "WebP":
        stream.seek(4)
        return int.from_bytes(stream.read(4), "little") + 8 <= length
    if kind == "BMP":
        return all(_raw_end(tile, picture) <= length for tile in picture.tile if tile.codec_name == "raw")
    if kind == "TIFF":
        return _tiff_end(picture) <= length
    return all(box.end <= length for box in boxes(stream, length))


def _raw_end(tile: ImageFile._Tile, picture: ImageFile.ImageFile) -> int:
    """Where the rows of a picture without compression end."""
    assert isinstance(tile.args, tuple)
    return tile.offset + picture.size[1] * int(tile.args[1])


def _tiff_end(picture: ImageFile.ImageFile) -> int:
    """Where the last strip or tile ends."""
    assert isinstance(picture, TiffImagePlugin.TiffImageFile)
    tags = picture.tag_v2
    ends = [0]
    for starts, counts in ((273, 279), (324, 325)):
        ends += [start + count for start, count in zip(tags.get(starts, ()), tags.get(counts, ()), strict=False)]
    return max(ends)


def _png_chunks(stream: IO[bytes]) -> Iterator[tuple[bytes, int, int]]:
    """Name, position and length of the data of each whole chunk up to IEND."""
    length, position = _bytes(stream), 8
    while position + 12 <= length:
        stream.seek(position)
        head = stream.read(8)
        size = int.from_bytes(head[:4], "big")
        if position + 12 + size > length:
            return
        yield head[4:], position + 8, size
        if head[4:] == b"IEND":
            return
        position += 12 + size


def _note_exif_of_png(picture: ImageFile.ImageFile, stream: IO[bytes]) -> None:
    for chunk, position, size in _png_chunks(stream):
        if chunk == b"eXIf":
            stream.seek(position)
            picture.info["exif"] = b"Exif\0\0" + stream.read(size)


def _bytes(stream: IO[bytes]) -> int:
    return os.fstat(stream.fileno()).st_size
