"""What the header of a video says, read by PyAV."""

from __future__ import annotations

import re
from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import av
import av.format
import av.logging
import numpy as np

from logvggt_jax.reconstruction.sources.deinterlacing import is_interlaced
from logvggt_jax.reconstruction.sources.video_notes import (
    all_around,
    high_dynamic_range,
    no_times,
    oblong_pixels,
    several_videos,
)

# FFmpeg's numbers of what a lens or its stitching program projects onto.
_PROJECTIONS = {0: "equirectangular", 1: "a cube map", 2: "equirectangular", 3: "half equirectangular", 5: "fisheye"}
STORE_DECODING_TIMES = ("avi", "asf")
"""Formats that state when packets are decoded, from the beginning of the file; times of presentation, which FFmpeg
makes up, are those of packets that follow."""
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}


class PacketNotes(NamedTuple):
    """What the packet of a frame tells.

    Attributes:
      matrix: as the camera noted it in a JPEG, see `orientation`; None where nothing is turned.
      follows_loss: see `Picture`.
    """

    matrix: np.ndarray | None
    follows_loss: bool


def notes_on(
    name: str, container: av.container.InputContainer, stream: av.video.stream.VideoStream, frame: av.VideoFrame
) -> Iterator[str]:
    """What the user should know of a video, as far as it shows in the header and the first frame."""
    # Of one that no decoder is there for, as damage may feign one, no size is known.
    streams = [each for each in moving_streams(container) if each.codec_context is not None]
    if len(streams) > 1:
        sizes = [(each.height, each.width) for each in streams]
        yield several_videos(name, sizes, [str(each.index) for each in streams], str(stream.index))
    if has_no_times(container):
        yield no_times(name, float(average_rate(container, stream) or 1))
    if is_interlaced(frame, stream):
        yield f"{name} is interlaced: its frames are deinterlaced (bwdif), and finest lines lose some detail"
    spherical = _side_data(frame, "SPHERICAL")
    if spherical and (projection := _PROJECTIONS.get(int.from_bytes(spherical[:4], "little"))):
        yield all_around(name, projection)
    if transfer := _HDR_TRANSFERS.get(frame.color_trc):
        yield high_dynamic_range(name, transfer, "reduced to 8 bits without tone mapping, which makes them look pale")
    ratio = stream.sample_aspect_ratio
    if ratio and ratio != 1:
        yield oblong_pixels(name, ratio.numerator, ratio.denominator)


def display_matrix(frame: av.VideoFrame, stream: av.video.stream.VideoStream) -> np.ndarray | None:
    """See `orientation`; None where nothing is turned. A frame's `opaque` is what its packet told."""
    if frame.opaque is not None and frame.opaque.matrix is not None:
        return frame.opaque.matrix
    if data := _side_data(frame, "DISPLAYMATRIX"):
        return np.frombuffer(data, np.int32)[:9].reshape(3, 3)[:2, :2].astype(np.float64)
    tags = {name.lower(): value for name, value in stream.metadata.items()}
    if tags.get("rotate", "").lstrip("-").isdecimal():
        # Clockwise, as older programs wrote it into any file.
        return _clockwise(int(tags["rotate"]))
    return _clockwise(-frame.rotation) if frame.rotation else None


class DisplayMatrices:
    """How the frames of a stream are turned, see `display_matrix`.

    What a frame tells beside its picture is read of the first one and where the rotation changes alone: a frame that is
    asked for it lives, pixels and all, until Python looks for objects that refer to each other.
    """

    def __init__(self, stream: av.video.stream.VideoStream) -> None:
        self._stream = stream
        self._rotation: int | None = None
        self._matrix: np.ndarray | None = None

    def of(self, frame: av.VideoFrame) -> np.ndarray | None:
        """None where nothing is turned."""
        if frame.opaque is not None and frame.opaque.matrix is not None:
            return frame.opaque.matrix
        if frame.rotation != self._rotation:
            self._rotation, self._matrix = frame.rotation, display_matrix(frame, self._stream)
        return self._matrix


def _clockwise(degrees: int) -> np.ndarray:
    return np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), round(degrees / 90) % 4)


def _side_data(frame: av.VideoFrame, kind: str) -> bytes | None:
    """What a frame tells beside its picture; None where it tells none of this kind.

    PyAV gives none at all of a frame that has some which is newer than PyAV, as EXIF in the pictures of a camera; nor
    does the rotation that it gives besides tell whether they are mirrored.
    """
    try:
        data = frame.side_data.get(kind)
    except ValueError:
        return None
    return None if data is None else bytes(data)


def moving_streams(container: av.container.InputContainer) -> list[av.video.stream.VideoStream]:
    """The video streams but for cover pictures, which are streams too."""
    pictures = av.stream.Disposition.attached_pic | av.stream.Disposition.timed_thumbnails
    return [stream for stream in container.streams.video if not stream.disposition & pictures]


def has_no_times(container: av.container.InputContainer) -> bool:
    """Whether the format states none, as a bare H.264 stream."""
    return bool(container.format.flags & av.format.Flags.no_timestamps.value)


def average_rate(container: av.container.InputContainer, stream: av.video.stream.VideoStream) -> Fraction | None:
    """Frames a second on average."""
    if has_no_times(container):
        # What the codec states, if it does: the library guesses 24 for 12, and the average is a default.
        return stream.codec_context.framerate or stream.guessed_rate or stream.average_rate
    # Of some formats the library takes the unit of time for the distance of two frames.
    return min((rate for rate in (stream.average_rate, stream.guessed_rate) if rate), default=None)


def duration(
    container: av.container.InputContainer, stream: av.video.stream.VideoStream, begins: int | None
) -> float | None:
    """Seconds from the first frame to the end of the last; `begins` is the time stamp of the first frame where that is
    known, as the library may know none of a stream that does not begin with a key frame."""
    is_matroska = "matroska" in container.format.name
    if stream.duration and not is_matroska:  # which states that of the file, and the library takes it for the stream's
        before = (begins or 0) if container.format.name in STORE_DECODING_TIMES else 0
        seconds = float((stream.duration - before) * stream.time_base)
        return seconds if seconds > 0 else None  # of damaged times
    start = float((stream.start_time or begins or 0) * stream.time_base)
    if tag := re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", stream.metadata.get("DURATION", "")):
        # Matroska's, counted from the beginning of the file.
        hours, minutes, seconds = map(float, tag.groups())
        return max(0.0, 3600 * hours + 60 * minutes + seconds - start) or None
    if not container.duration or len(container.streams) > 1:
        return None
    total = container.duration / av.time_base
    return total - start if is_matroska else total


def stated_codec(container: av.container.InputContainer, index: int) -> str:
    """The codec of a stream as FFmpeg names and describes it, by what has been read so far; there may be no decoder for
    it."""
    level = av.logging.get_level()
    # The library tells it in its log only.
    av.logging.set_level(av.logging.INFO)
    try:
        log = container.dumps_format()
    finally:
        av.logging.set_level(level)
    found = re.search(rf"Stream #0:{index}\b[^\n]*Video: ([^,\n]+)", log)
    return found[1] if found else "(unknown)"
