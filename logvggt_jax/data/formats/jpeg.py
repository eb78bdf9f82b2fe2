"""JPEG pictures: the whole ones are read, however odd their file is, and the truncated ones are told.

libjpeg fills what is missing with grey and complains on standard error only. Pillow feeds it piece by piece and raises
where it asks for more than there is; that covers all but a few kinds, which are decided here.
"""

import io
import re

import numpy as np
from PIL import Image, JpegImagePlugin

JPEG_START = b"\xff\xd8"
_END = b"\xff\xd9"
_SCAN = b"\xff\xda"
# Bits in place of what a file lacks, with a restart marker of each kind. Where pixels are missing they become other
# pixels than the zeros that libjpeg assumes; where none is missing nobody looks at them.
_OTHER_BITS = b"".join(b"\x5a\xa5\x33\xcc" * 4 + bytes((0xFF, 0xD0 + number % 8)) for number in range(16))
_MOST_ZEROS = 16
# What disks and networks leave of a lost part. As coded pixels it stands for some 300 blocks of one colour, for a third
# as many beside each other where colours are coded as well, half of which may lie in the next row; or for noise that no
# picture has.
LOST = bytes(256)
_PLAIN = 32


class _Pixels(JpegImagePlugin.JpegImageFile):
    """A picture whose camera data are left alone: Pillow warns on opening it if they are odd."""

    def getexif(self) -> Image.Exif:
        return Image.Exif()


def decode_jpeg(data: bytes) -> Image.Image:
    """The pixels as stored, without orientation, in mode L, RGB or CMYK.

    Read are also pictures without an end marker, with stray bytes between the segments or after the end.

    Raises:
      OSError: pixels are missing, even where an end marker was appended afterwards.
      Exception: no JPEG, or of a kind that libjpeg does not read; Pillow raises many types.
    """
    # Zeros to the full size are what an interrupted download or a crash leaves; libjpeg would take them for pixels.
    zeros = len(data) - len(data.rstrip(b"\0"))
    if zeros > _MOST_ZEROS:
        data = data[:-zeros]
    try:
        picture = _decode(data)
    except OSError:
        content = data.rstrip(_END[:1])
        picture = _decode(content + _END)
        if _lacks_scans(content, picture) or _asks_for_more(content, b"", picture):
            raise
        return picture
    scan = first_scan(data)
    if LOST in data[scan : data.find(_END, scan)] and not _has_plain_area(picture):
        raise OSError("part of the picture is zeros")
    if "progressive" in picture.info or ends_flat(np.asarray(picture.crop(_last_unit(picture.size)))):
        end = data.rfind(_END)
        if _asks_for_more(data[:end], data[end:], picture):
            raise OSError("part of the picture is missing")
    return picture


def ends_flat(pixels: np.ndarray) -> bool:
    """Whether the last coded unit of a picture [H, W] or [H, W, C] is of one colour, as those that libjpeg makes up
    are."""
    left, top, right, bottom = _last_unit((pixels.shape[1], pixels.shape[0]))
    unit = pixels[top:bottom, left:right]
    return bool((unit == unit[0, 0]).all())


def first_scan(data: bytes) -> int:
    """Position of the first scan's marker; thumbnails in the header lie before it. Errors as `decode_jpeg`."""
    stream = io.BytesIO(data)
    _Pixels(stream)
    # Pillow stops behind the scan's header.
    return data.rfind(_SCAN, 0, stream.tell())


def _decode(data: bytes) -> Image.Image:
    picture = _Pixels(io.BytesIO(data))
    picture.load()
    return picture


def _lacks_scans(data: bytes, picture: Image.Image) -> bool:
    """Whether a progressive picture ends before the scans that bring the last bit of all its coefficients."""
    if "progressive" not in picture.info:
        return False
    complete = set()
    # Scan headers are as in ITU T.81, B.2.3.
    for scan in re.finditer(_SCAN, data[first_scan(data) :]):
        count, *header = scan.string[scan.end() + 2 : scan.end() + 14]
        names, (begin, end, bits) = header[: 2 * count : 2], header[2 * count : 2 * count + 3]
        if bits & 0x0F == 0:
            complete |= {(name, coefficient) for name in names for coefficient in range(begin, end + 1)}
    return len(complete) < 64 * len(picture.getbands())


def _has_plain_area(picture: Image.Image) -> bool:
    """Whether many blocks of 8 x 8 pixels in a row are of one and the same colour."""
    pixels = np.asarray(picture)
    height, width = (length // 8 for length in pixels.shape[:2])
    blocks = pixels[: 8 * height, : 8 * width].reshape(height, 8, width, 8, -1)
    colours = blocks.min((1, 3))
    plain = (blocks.max((1, 3)) == colours).all(-1)
    same = plain[:, 1:] & plain[:, :-1] & (colours[:, 1:] == colours[:, :-1]).all(-1)
    run = longest = np.zeros(height, np.int64)
    for column in same.T:
        run = (run + 1) * column
        longest = np.maximum(longest, run)
    return bool((longest + 1 >= min(_PLAIN, width // 2)).any())


def _asks_for_more(content: bytes, tail: bytes, picture: Image.Image) -> bool:
    """Whether other bits between the `content` and `tail` of a file make another picture: it lacks pixels there."""
    return picture.tobytes() != _decode(content + _OTHER_BITS + (tail or _END)).tobytes()


def _last_unit(size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what surely is of the last coded unit of a picture of (W, H).

    Units are of 8 x 8 pixels or more; those that are smoothed with other units' are left out.
    """
    left, top = (length - max(1, (length - 1) % 8 - 1) for length in size)
    return left, top, *size
