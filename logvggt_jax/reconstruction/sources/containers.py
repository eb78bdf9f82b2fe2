"""Which format a video file has, as its first bytes say, of those in which OpenCV alone tells damage as PyAV does."""

import re
from pathlib import Path

MP4, AVI, MATROSKA, FLASH, WINDOWS_MEDIA = "mp4", "avi", "matroska", "flv", "asf"

# Bytes within which a recording of television that was cut anywhere has its first whole packets.
_HEAD = 1 << 16
_BEGINNINGS = (
    (MP4, re.compile(rb".{4}(?:ftyp|moov|mdat|wide|free|skip|pnot)", re.DOTALL)),
    (AVI, re.compile(rb"RIFF.{4}AVI ", re.DOTALL)),
    (FLASH, re.compile(rb"FLV")),
    (WINDOWS_MEDIA, re.compile(re.escape(bytes.fromhex("3026b275 8e66cf11")))),
    (MATROSKA, re.compile(re.escape(bytes.fromhex("1a45dfa3")))),
    ("gif", re.compile(rb"GIF8")),
    # Of MPEG-1 and MPEG-2 decoders drop pictures in silence, which without times are not missed.
    ("a bare stream", re.compile(rb"\x00{2,3}\x01(?![\xb3\xba])|\xff\xd8")),
    ("ts", re.compile(rb".*?\x47(?:(?:.{187}\x47){4}|(?:.{191}\x47){4}|(?:.{203}\x47){4})", re.DOTALL)),
)


def container_of(path: Path) -> str | None:
    """None for other formats, where reading may end at damage, or frames may be missing, without a word."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return next((name for name, begins in _BEGINNINGS if begins.match(head)), None)
