"""The packets of a video as OpenCV reads them undecoded."""

from __future__ import annotations

import io
import itertools
import math
import re
import struct
import tempfile
import warnings
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
from PIL import Image

from logvggt_jax.reconstruction.sources.h264_frame_numbers import FrameNumbers
from logvggt_jax.reconstruction.sources.mpeg_picture_numbers import PictureNumbers
from logvggt_jax.reconstruction.sources.opencv_messages import captured_messages, tells_corrupt_packet
from logvggt_jax.reconstruction.sources.orientation import noted_orientation

# Where the parameters of a stream begin, by which FFmpeg recognises it, and how many bytes of them state the size; for
# None, those up to the next start code.
_START_CODE = b"\x00\x00\x01"
_H264 = re.compile(rb"\x00\x00\x01[\x07\x27\x47\x67]"), None
_HEVC = re.compile(rb"\x00\x00\x01\x40.*?\x00\x00\x01\x42", re.DOTALL), None
_MPEG = re.compile(rb"\x00\x00\x01\xb3"), 12
_PARAMETERS: dict[bytes, tuple[re.Pattern[bytes], int | None]] = {
    b"h264": _H264,
    b"avc1": _H264,
    b"hevc": _HEVC,
    b"hvc1": _HEVC,
    b"hev1": _HEVC,
    b"mpg1": _MPEG,
    b"mpg2": _MPEG,
    b"vp80": (re.compile(rb"...\x9d\x01\x2a....", re.DOTALL), 10),
    b"vp90": (re.compile(rb""), 12),
    b"av01": (re.compile(rb""), 32),
    b"mjpg": (re.compile(rb"\xff\xd8"), 1 << 16),
    b"mpng": (re.compile(rb"\x89PNG"), 24),
}
_H264_NAMES = (b"h264", b"avc1")
_PICTURES = (b"mjpg", b"mpng")
_OF_CAMERAS = b"mjpg"
# Codecs that FFmpeg recognises in the container IVF only.
_IN_IVF = (b"vp90", b"av01")
# Codecs of which every packet shows a frame of its own, but for empty ones, which stand for no change.
_FRAME_A_PACKET = (
    *(b"h264", b"avc1", b"hevc", b"hvc1", b"hev1", b"mjpg", b"fmp4", b"mp4v", b"xvid", b"divx", b"dx50"),
    *(b"mpg1", b"mpg2"),
)
# Codecs that are stored in the order in which they are shown; a packet need not show a frame.
_AS_SHOWN = (b"vp80", b"vp90", b"av01")
_EMPTY_PACKET = 8
# What a description begins with of a stream whose units have their lengths before them, which OpenCV replaces.
_WITH_LENGTHS = b"\1"
# What files begin with that may lack presentation times: AVI, MXF, ASF; and streams of programs, but for MPEG's own.
_LACK_TIMES = (b"RIFF", b"\x06\x0e\x2b\x34", b"\x30\x26\xb2\x75")
_PROGRAMS, _OF_PROGRAMS = b"\0\0\1\xba", (b"mpg1", b"mpg2")
# FFmpeg reads so many packets ahead of the one that it hands out.
_AHEAD = 3
# Errors in a row after which nothing more is to be read.
_MOST_ERRORS = 64


class Packet(NamedTuple):
    """One packet of the video stream.

    Attributes:
      stamp: presentation time in microseconds from the stream's start.
      holds_frame: it is not empty.
      key: decoding can begin with it.
      size: (H, W) before rotation, as the key frames so far state it; None where none does.
      orientation: EXIF's, that the camera noted in a JPEG; 1 for none.
      whole: nothing of it is missing, nor anything just before it, as far as the container tells.
      follows_loss: see `Picture`.
    """

    stamp: int
    holds_frame: bool
    key: bool
    size: tuple[int, int] | None
    orientation: int
    whole: bool
    follows_loss: bool


class PacketReader:
    """The packets of a file in the order in which they are stored.

    Attributes:
      frame_each: each is known to show one frame, at a time that is known.
      as_shown: they are stored in the order in which frames are shown.
      begin: seconds from the file's beginning to the first, once that is read.
      change: names of the codec so far and of the one that follows, once that is reached; no packet of that is read.

    Args:
      source: the file's absolute path.
    """

    def __init__(self, source: str) -> None:
        # What it says of damage is said to the decoder as well.
        with captured_messages():
            self._capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        self._codec = self._codec_now()
        self.change: tuple[str, str] | None = None
        self._told_corrupt = False
        self.begin = 0.0
        with Path(source).open("rb") as file:
            self.as_shown = self._codec in _AS_SHOWN
            head = file.read(4)
            timed = head not in _LACK_TIMES and (head != _PROGRAMS or self._codec in _OF_PROGRAMS)
            self.frame_each = self._codec in _FRAME_A_PACKET and timed

    def __iter__(self) -> Iterator[Packet | None]:
        """None stands for one that cannot be read."""
        held: deque[Packet | None] = deque()
        for packet in self._read():
            held.append(packet)
            if len(held) > _AHEAD:
                yield self._checked(held)
        if self._told_corrupt and held and (last := held.pop()) is not None:
            held.append(last._replace(whole=False))
        while held:
            yield self._checked(held)

    def _checked(self, held: deque[Packet | None]) -> Packet | None:
        """The first of these packets. One that is not whole just before a key frame is where recordings are joined."""
        packet = held.popleft()
        if packet is None or packet.whole or any(each is not None and each.key for each in held):
            return packet
        return packet._replace(follows_loss=True)

    def _read(self) -> Iterator[Packet | None]:
        size, head, errors, first = None, b"", 0, True
        numbers: FrameNumbers | PictureNumbers | None = None
        if self._codec in _H264_NAMES:
            numbers = FrameNumbers(self._description())
        elif self._codec in _OF_PROGRAMS:
            numbers = PictureNumbers()
        while self._capture.isOpened() and errors < _MOST_ERRORS:
            with captured_messages() as messages:
                read, content = self._capture.retrieve() if self._capture.grab() else (False, None)
            self._told_corrupt = tells_corrupt_packet(messages) or self._told_corrupt
            if not read or content is None:
                errors += 1
                continue
            if (codec := self._codec_now()) != self._codec and not {codec, self._codec} <= set(_OF_PROGRAMS):
                self.change = _name(self._codec), _name(codec)
                return
            # At the end there are only errors.
            yield from itertools.repeat(None, errors)
            errors = 0
            if first:
                first, self.begin = False, self._since_beginning()
            stamp = round(1000 * self._capture.get(cv2.CAP_PROP_POS_MSEC))
            key = bool(self._capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME))
            data = content.tobytes()
            orientation = 1
            if key:
                orientation = noted_orientation(data) if self._codec == _OF_CAMERAS else 1
                parameters, length = _parameters(data, self._codec)
                if parameters[:length] != head:
                    head, size = parameters[:length], _stated_size(parameters, self._codec) or size
            lossy = numbers is not None and numbers.follows_loss(data, key)
            whole, self._told_corrupt = not self._told_corrupt, False
            yield Packet(stamp, content.size > _EMPTY_PACKET, key, size, orientation, whole, lossy)

    def _codec_now(self) -> bytes:
        return (int(self._capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little").lower()

    def _since_beginning(self) -> float:
        """Seconds of the packet at hand. Milliseconds count from the first packet, but where presentation times, which
        the least number there is stands for if there are none, are not known."""
        frames, rate = self._capture.get(cv2.CAP_PROP_PTS), self._capture.get(cv2.CAP_PROP_FPS)
        known = frames >= 0 and math.isfinite(rate) and rate > 0
        return frames / rate if known else self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000

    def _description(self) -> bytes:
        """What the container knows of the stream, where packets begin with start codes; else it is in the packets."""
        place = round(self._capture.get(cv2.CAP_PROP_CODEC_EXTRADATA_INDEX))
        read, content = self._capture.retrieve(flag=place) if place > 0 else (False, None)
        described = content.tobytes() if read and content is not None else b""
        return b"" if described.startswith(_WITH_LENGTHS) else described

    def close(self) -> None:
        """Closes the file."""
        self._capture.release()


def _name(codec: bytes) -> str:
    """As FFmpeg calls a codec."""
    return "mpeg2video" if codec in _OF_PROGRAMS else codec.decode("latin-1").strip("\0 ")


def _parameters(packet: bytes, codec: bytes) -> tuple[bytes, int]:
    """A key frame from where it states the size, and within how many bytes; empty where that is not known."""
    begins, length = _PARAMETERS.get(codec, (None, None))
    found = begins.search(packet) if begins else None
    if found is None:
        return b"", 0
    if length is None:
        end = packet.find(_START_CODE, found.end())
        length = (end if end >= 0 else len(packet)) - found.start()
    return packet[found.start() :], length


def _stated_size(parameters: bytes, codec: bytes) -> tuple[int, int] | None:
    """(H, W) by what `_parameters` gave; None where it cannot be told."""
    if not parameters:
        return None
    if codec in _PICTURES:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of odd camera data
                with Image.open(io.BytesIO(parameters)) as picture:
                    return picture.height, picture.width
        except (OSError, ValueError):
            return None
    if codec == b"vp80":
        # Two bits of each number tell how to enlarge it.
        width, height = (each & 0x3FFF for each in struct.unpack_from("<HH", parameters, 6))
        return height, width
    if codec in _IN_IVF:
        head = b"DKIF" + struct.pack("<HH4sHHIIII", 0, 32, codec.upper(), 16, 16, 25, 1, 1, 0)
        parameters = head + struct.pack("<IQ", len(parameters), 0) + parameters
    try:
        # From memory OpenCV reads as well, but has been seen to end the process.
        with tempfile.TemporaryDirectory() as folder, captured_messages():
            path = Path(folder) / "packet"
            path.write_bytes(parameters)
            alone = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
            size = (round(alone.get(cv2.CAP_PROP_FRAME_HEIGHT)), round(alone.get(cv2.CAP_PROP_FRAME_WIDTH)))
            alone.release()
    except OSError:  # no place for a temporary file
        return None
    return size if min(size) > 0 else None
