"""The packets of a video as OpenCV reads them undecoded."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2

from logvggt_jax.reconstruction.sources.h264_frame_numbers import FrameNumbers
from logvggt_jax.reconstruction.sources.jpeg_scans import holds_scan
from logvggt_jax.reconstruction.sources.mpeg_picture_numbers import PictureNumbers
from logvggt_jax.reconstruction.sources.opencv_codecs import VP9, codec_name, codec_of
from logvggt_jax.reconstruction.sources.opencv_messages import captured_messages, tells_corrupt_packet
from logvggt_jax.reconstruction.sources.orientation import noted_orientation
from logvggt_jax.reconstruction.sources.stated_sizes import stated_size
from logvggt_jax.reconstruction.sources.vp9_frames import FrameSizes

_H264, _OF_CAMERAS, _OF_MPEG = b"h264", b"mjpg", (b"mpg1", b"mpg2")
# What a description begins with of a stream whose units have their lengths before them, which OpenCV replaces.
_WITH_LENGTHS = b"\1"
STORE_DECODING_TIMES = (b"RIFF", b"\x30\x26\xb2\x75")
"""What files begin with that state when packets are decoded, not when their frames are shown: AVI and ASF."""
# Microseconds below which a time stands for none, in a part of the file that is damaged.
_NO_TIME = -1 << 62
# FFmpeg reads so many packets ahead of the one that it hands out.
_AHEAD = 2
# Errors in a row after which nothing more is to be read.
_MOST_ERRORS = 64


class Packet(NamedTuple):
    """One packet of the video stream.

    Attributes:
      stamp: presentation time in microseconds from the stream's start.
      holds_frame: it shows a frame of its own.
      key: decoding can begin with it.
      size: (H, W) before rotation, as the key frames so far state it; None where none does.
      orientation: EXIF's, that the camera noted in a JPEG; 1 for none.
      whole: nothing of it is missing, nor anything just before it, as far as the container tells.
      follows_loss: see `Picture`.
      holds_picture: what its decoder gives is more than what was in memory before.
    """

    stamp: int
    holds_frame: bool
    key: bool
    size: tuple[int, int] | None
    orientation: int
    whole: bool
    follows_loss: bool
    holds_picture: bool


class PacketReader:
    """The packets of a file in the order in which they are stored.

    Attributes:
      frame_each: each is known to show one frame, at a time that is known.
      reordered, holds_one: see `Codec`.
      begin: seconds from the file's beginning to the first, once that is read.
      change: names of the codec so far and of the one that follows, once that is reached; no packet of that is read.

    Args:
      source: the file's absolute path.
    """

    def __init__(self, source: str) -> None:
        # What it says of damage is said to the decoder as well.
        with captured_messages():
            self._capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        self._codec = codec_name(self._capture)
        self.change: tuple[str, str] | None = None
        self._told_corrupt = False
        self.begin = 0.0
        with Path(source).open("rb") as file:
            kind = codec_of(self._codec)
            self._empty = kind.empty if kind else 0
            self.frame_each = kind is not None and not (kind.reordered and file.read(4) in STORE_DECODING_TIMES)
            self.reordered, self.holds_one = (kind.reordered, kind.holds_one) if kind else (True, False)

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
        description = self._description()
        size, errors, first = stated_size(description, self._codec), 0, True
        numbers: FrameNumbers | PictureNumbers | None = None
        if self._codec == _H264:
            numbers = FrameNumbers(description)
        elif self._codec in _OF_MPEG:
            numbers = PictureNumbers()
        frames = FrameSizes() if self._codec == VP9 else None
        while self._capture.isOpened() and errors < _MOST_ERRORS:
            with captured_messages() as messages:
                read, content = self._capture.retrieve() if self._capture.grab() else (False, None)
            self._told_corrupt = tells_corrupt_packet(messages) or self._told_corrupt
            if not read or content is None:
                errors += 1
                continue
            if (codec := codec_name(self._capture)) != self._codec and not {codec, self._codec} <= set(_OF_MPEG):
                self.change = _name(self._codec), _name(codec)
                return
            # At the end there are only errors.
            yield from itertools.repeat(None, errors)
            errors = 0
            if first:
                first, self.begin = False, self._since_beginning()
            stamp = round(1000 * self._capture.get(cv2.CAP_PROP_POS_MSEC))
            if stamp < _NO_TIME:
                yield None
                continue
            key = bool(self._capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME))
            data = content.tobytes()
            orientation = 1
            if key:
                orientation = noted_orientation(data) if self._codec == _OF_CAMERAS else 1
                size = stated_size(data, self._codec) or size
            lossy = numbers is not None and numbers.follows_loss(data, key)
            whole, self._told_corrupt = not self._told_corrupt, False
            shows = content.size > self._empty
            if frames is not None and shows:
                shows, changed = frames.follow(data)
                size = changed or size
            holds_picture = self._codec != _OF_CAMERAS or holds_scan(data)
            yield Packet(stamp, shows, key, size, orientation, whole, lossy, holds_picture)

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
    return "mpeg2video" if codec in _OF_MPEG else codec.decode("latin-1").strip("\0 ")
