"""JPEG pictures: the whole ones are read, however odd their file is, and the truncated ones are told.

libjpeg fills what is missing with grey and complains on standard error only. Pillow feeds it piece by piece and raises
where it asks for more than there is; that covers all but two kinds, which are decided here.
"""

import io

from PIL import Image, JpegImagePlugin

JPEG_START = b"\xff\xd8"
_END = b"\xff\xd9"
# Bits in place of what a file lacks. Where pixels are missing they become other pixels than the zeros that libjpeg
# assumes; where none is missing nobody looks at them.
_OTHER_BITS = b"\x5a\xa5\x33\xcc" * 16
_MOST_PADDING = 16


def decode_jpeg(data: bytes) -> Image.Image:
    """The pixels as stored, without orientation, in mode L, RGB or CMYK.

    Read are also pictures without an end marker, with stray bytes between the segments or after the end.

    Raises:
      OSError: pixels are missing, even where an end marker was appended afterwards.
      SyntaxError: no JPEG, or of a kind that libjpeg does not read.
    """
    try:
        picture = _decode(data)
    except OSError:
        # Zeros to the full size are what an interrupted download or a crash leaves; they are no pixels.
        zeros = len(data) - len(data.rstrip(b"\0"))
        content = (data[:-zeros] if zeros > _MOST_PADDING else data).rstrip(b"\xff")
        picture = _decode(content + _END)
        if picture.tobytes() != _decode(content + _OTHER_BITS + _END).tobytes():
            raise
        return picture
    if _ends_flat(picture):
        end = data.rfind(_END)
        if picture.tobytes() != _decode(data[:end] + _OTHER_BITS + data[end:]).tobytes():
            raise OSError("the lower part of the picture is missing")
    return picture


def _decode(data: bytes) -> Image.Image:
    picture = JpegImagePlugin.JpegImageFile(io.BytesIO(data))
    picture.load()
    return picture


def _ends_flat(picture: Image.Image) -> bool:
    """Whether the last pixels are of one colour, as those that libjpeg makes up are."""
    width, height = picture.size
    corner = picture.crop((max(0, width - 8), height - 1, width, height))
    return len(corner.getcolors() or ()) == 1
