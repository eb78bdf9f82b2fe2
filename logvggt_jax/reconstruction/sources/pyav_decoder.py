"""Decoding of videos by FFmpeg's libraries through PyAV."""

from __future__ import annotations

import heapq
import itertools
import re
from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from functools import partial

import av
import av.error
import av.filter
import av.logging
import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.sources.decoding import Damage, Picture, VideoHeader

# Text and single images, which FFmpeg would show as videos of one frame.
_NO_VIDEOS = ("image2", "tty", "bin", "xbin", "adf", "idf")
# Formats that state their duration; FFmpeg guesses that of others.
_STATE_DURATION = ("mov", "matroska", "avi", "flv", "asf")
_TOP_FIELD_FIRST, _BOTTOM_FIELD_FIRST = (2, 5), (3, 4)
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
# Errors in a row after which a file that cannot be read on counts as ended.
_MOST_READ_ERRORS = 16
# Some formats mark no key frames: after so many packets the first that decodes begins the video.
_LONGEST_LEAD = 300
# Pixels above which frames are decoded side by side.
_LARGE = 1920 * 1088
# Packets whose frame has not come out; no codec holds back so many.
_MOST_WAITING = 512


class PyAVDecoder:
    """See `VideoDecoder`.

    Args:
      url: what FFmpeg opens.
      name: what messages call it.
      timeout: seconds to wait for a network stream; None for files.
    """

    def __init__(self, url: str, name: str, timeout: float | None = None) -> None:
        self._url, self._name, self._timeout = url, name, timeout

    def header(self) -> VideoHeader:
        """See `VideoDecoder.header`."""
        with self._open() as container:
            stream = self._stream(container)
            frame = next((frame for _, frame in self._decode(container, stream) if frame is not None), None)
            if frame is None:
                codec = stream.codec_context.codec.long_name
                raise InputError(f"{self._name} holds no frame that can be decoded ({codec}); re-encode the video")
            interlaced = _is_interlaced(frame, stream)
            rate, seconds = stream.average_rate or stream.guessed_rate, _duration(container, stream)
            return VideoHeader(
                size=_shown_size(frame, _display_matrix(frame, stream)),
                rate=float(rate) if rate else None,
                frames=_likely_frames(stream.frames, seconds, rate),
                announced=stream.frames or None,
                seconds=seconds if container.format.name.startswith(_STATE_DURATION) else None,
                notes=tuple(_notes(self._name, frame, stream, interlaced=interlaced)),
            )

    def pictures(self) -> Iterator[Picture | Damage]:
        """See `VideoDecoder.pictures`."""
        with self._open() as container:
            stream = self._stream(container)
            deinterlacer = Deinterlacer(stream, self._name)
            for damage, frame in self._decode(container, stream):
                if frame is not None:
                    ready = deinterlacer.push(frame)
                else:
                    # What was pushed before is shown before.
                    ready = deinterlacer.drain()
                for decoded, whole in ready:
                    yield self._picture(decoded, whole, stream)
                if damage is not None:
                    yield damage
            for decoded, whole in deinterlacer.drain():
                yield self._picture(decoded, whole, stream)

    def _picture(self, decoded: av.VideoFrame, whole: av.VideoFrame, stream: av.video.stream.VideoStream) -> Picture:
        matrix = _display_matrix(decoded, stream)
        # Filters pass on neither.
        whole.colorspace, whole.color_range = decoded.colorspace, decoded.color_range
        return Picture(
            seconds=None if decoded.pts is None else float(decoded.pts * stream.time_base),
            size=_shown_size(decoded, matrix),
            convert=partial(self._convert, whole, matrix),
            damaged=decoded.is_corrupt,
        )

    def _convert(self, frame: av.VideoFrame, matrix: np.ndarray | None) -> np.ndarray:
        try:
            rgb = frame.reformat(
                format="rgb24",
                src_color_range=frame.color_range,
                dst_color_range="JPEG",
                interpolation="BICUBIC",
                threads=1,
            ).to_ndarray()
        except av.FFmpegError as error:
            raise InputError(
                f"{self._name}: pictures in the pixel format {frame.format.name} cannot be converted "
                f"({error.strerror}); re-encode it, for example to H.264 mp4"
            ) from error
        return rgb if matrix is None else _turn(rgb, matrix)

    def _open(self) -> av.container.InputContainer:
        options = {"rtsp_transport": "tcp"} if self._url.startswith("rtsp") else {}
        try:
            return av.open(self._url, options=options, metadata_errors="replace", timeout=self._timeout)
        except av.FFmpegError as error:
            if self._timeout is not None:
                late = isinstance(error, av.error.ExitError | av.error.TimeoutError)
                reason = f"no answer within {self._timeout:g} s" if late else error.strerror
                raise InputError(
                    f"{self._name} cannot be opened ({reason}): check address, network and password"
                ) from error
            raise InputError(
                f"{self._name} cannot be opened as a video ({error.strerror}): expected mp4, mov, avi, mkv, webm, ts "
                "or another format that FFmpeg reads, or a folder of images"
            ) from error

    def _stream(self, container: av.container.InputContainer) -> av.video.stream.VideoStream:
        """The video stream to decode."""
        if container.format.name in _NO_VIDEOS or container.format.name.endswith("_pipe"):
            kind = "text" if container.format.name in _NO_VIDEOS[1:] else "a single image"
            raise InputError(f"{self._name} is {kind}, not a video: give a video or the folder that holds the images")
        # Cover pictures of sound files are streams too.
        pictures = av.stream.Disposition.attached_pic | av.stream.Disposition.timed_thumbnails
        streams = [stream for stream in container.streams.video if not stream.disposition & pictures]
        if not streams:
            kinds = sorted({stream.type for stream in container.streams} - {"video"})
            raise InputError(
                f"{self._name} holds no video stream, only {' and '.join(kinds) or 'nothing'}: give the file that "
                "holds the pictures"
            )
        best = container.streams.best("video")
        stream = best if best in streams else streams[0]
        if stream.codec_context is None:
            raise InputError(
                f"{self._name}: its codec {_codec(container, stream.index)} cannot be decoded by the FFmpeg that PyAV "
                "brings; re-encode it, for example to H.264 mp4"
            )
        # Threads within a frame lose nothing when a packet is damaged. With threads over frames, which large pictures
        # need, the library drops what follows a damaged packet among the last few of the file.
        if stream.width * stream.height > _LARGE:
            stream.thread_type = "AUTO"
        return stream

    def _decode(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream
    ) -> Iterator[tuple[Damage | None, av.VideoFrame | None]]:
        """Frames in the order in which they are shown, with what is missing between them."""
        waiting: list[int] = []
        failures: deque[str] = deque()
        started = False
        packets = self._packets(container, stream)
        for number in itertools.count():
            packet = next(packets, None)
            if packet is None:
                break
            if isinstance(packet, str):
                failures.append(packet)
                continue
            # Frames before the first key frame refer to some that are not there: decoders show them grey.
            started = started or packet.is_keyframe or number >= _LONGEST_LEAD or not packet.size
            if not started:
                continue
            if packet.size and packet.pts is not None and not packet.is_discard:
                heapq.heappush(waiting, packet.pts)
                if len(waiting) > _MOST_WAITING:
                    heapq.heappop(waiting)
            try:
                frames = packet.decode()
            except av.error.EOFError:
                frames = []
            except av.FFmpegError as error:
                failures.append(str(error.strerror))
                frames = []
            for frame in frames:
                if frame.pts is not None:
                    yield from ((damage, None) for damage in _missing(waiting, failures, frame.pts, stream.time_base))
                yield None, frame
        if stream.width * stream.height > _LARGE:
            failures.extend("cannot be decoded" for _ in waiting[len(failures) :])
        for reason in failures:
            stamp = heapq.heappop(waiting) if waiting else None
            yield Damage(None if stamp is None else float(stamp * stream.time_base), reason), None

    def _packets(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream
    ) -> Iterator[av.Packet | str]:
        """Packets, an empty one at the end; a reason where reading fails."""
        errors = 0
        while errors < _MOST_READ_ERRORS:
            try:
                for packet in container.demux(stream):
                    yield packet
                    errors = 0
                return
            except av.FFmpegError as error:
                errors += 1
                if errors == 1:
                    yield f"cannot be read: {error.strerror}"
                if self._timeout is not None:
                    break
        # The decoder still holds frames.
        empty = av.Packet()
        empty.stream = stream
        yield empty


class Deinterlacer:
    """Makes whole pictures of those that show two moments in alternate lines; others pass unchanged.

    Frames come out in order, as many as go in, one later than they went in once an interlaced one has been met.

    Args:
      stream: the stream, whose header may say that it is interlaced.
      name: what messages call it.
    """

    def __init__(self, stream: av.video.stream.VideoStream, name: str) -> None:
        self._stream, self._name = stream, name
        self._graph: av.filter.Graph | None = None
        self._made_for: tuple[object, ...] = ()
        self._inside: deque[av.VideoFrame] = deque()

    def push(self, frame: av.VideoFrame) -> Iterator[tuple[av.VideoFrame, av.VideoFrame]]:
        """Takes a frame; gives frames that are ready, each as it was decoded and as it is to be shown."""
        if self._graph is None and not _is_interlaced(frame, self._stream):
            yield frame, frame
            return
        made_for = (frame.width, frame.height, frame.format.name, frame.colorspace, frame.color_range)
        if self._graph is None or made_for != self._made_for:
            yield from self.drain()
            try:
                self._graph, self._made_for = self._build(frame), made_for
            except av.FFmpegError as error:
                raise InputError(
                    f"{self._name} is interlaced, and its pixel format {frame.format.name} cannot be deinterlaced "
                    f"({error.strerror}): do it beforehand with ffmpeg -i INPUT -vf bwdif=send_frame OUTPUT.mp4"
                ) from error
        self._inside.append(frame)
        self._graph.push(frame)
        yield from self._ready()

    def drain(self) -> Iterator[tuple[av.VideoFrame, av.VideoFrame]]:
        """Gives all frames that are inside."""
        if self._graph is not None:
            self._graph.push(None)
            yield from self._ready()
            self._graph = None

    def _ready(self) -> Iterator[tuple[av.VideoFrame, av.VideoFrame]]:
        while self._inside and self._graph is not None:
            try:
                whole = self._graph.pull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            yield self._inside.popleft(), whole

    def _build(self, frame: av.VideoFrame) -> av.filter.Graph:
        order = self._stream.codec_context.field_order
        # A file whose decoder does not mark frames may still say of all of them that they are interlaced.
        everything = not frame.interlaced_frame and _is_interlaced(frame, self._stream)
        graph = av.filter.Graph()
        source = graph.add(
            "buffer",
            video_size=f"{frame.width}x{frame.height}",
            pix_fmt=frame.format.name,
            time_base=str(self._stream.time_base),
            pixel_aspect="1/1",
            colorspace=str(int(frame.colorspace)),
            range=str(int(frame.color_range)),
        )
        parity = "auto" if not everything else "tff" if order in _TOP_FIELD_FIRST else "bff"
        bwdif = graph.add("bwdif", mode="send_frame", parity=parity, deint="all" if everything else "interlaced")
        graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
        return graph


def _is_interlaced(frame: av.VideoFrame, stream: av.video.stream.VideoStream) -> bool:
    return frame.interlaced_frame or stream.codec_context.field_order in (*_TOP_FIELD_FIRST, *_BOTTOM_FIELD_FIRST)


def _missing(waiting: list[int], failures: deque[str], shown: int, time_base: Fraction) -> Iterator[Damage]:
    """The frames before the one with time stamp `shown` that failed; takes all up to it from `waiting`."""
    while waiting and waiting[0] <= shown:
        stamp = heapq.heappop(waiting)
        if stamp < shown and failures:
            yield Damage(float(stamp * time_base), failures.popleft())


def _likely_frames(stated: int, seconds: float | None, rate: Fraction | None) -> int | None:
    """Number of frames that are shown; an edited file states those as well that it does not show."""
    by_time = max(1, round(seconds * rate)) if seconds and rate else None
    return min(stated, by_time) if stated and by_time else stated or by_time


def _display_matrix(frame: av.VideoFrame, stream: av.video.stream.VideoStream) -> np.ndarray | None:
    """[2, 2] matrix D with (x, y) D the place, but for a shift, where the pixel (x, y) is shown; None for none."""
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            return np.frombuffer(bytes(data), np.int32)[:9].reshape(3, 3)[:2, :2].astype(np.float64)
    tags = {name.lower(): value for name, value in stream.metadata.items()}
    if tags.get("rotate", "").lstrip("-").isdecimal():
        # Clockwise, as older programs wrote it into any file.
        return np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), round(int(tags["rotate"]) / 90) % 4)
    return None


def _is_transposed(matrix: np.ndarray) -> bool:
    return bool(abs(matrix[0, 1]) > abs(matrix[0, 0]))


def _turn(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] turned and mirrored by the matrix, or by the quarter turn nearest to it."""
    if _is_transposed(matrix):
        image, across, down = image.swapaxes(0, 1), matrix[1, 0], matrix[0, 1]
    else:
        across, down = matrix[0, 0], matrix[1, 1]
    return np.ascontiguousarray(image[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def _shown_size(frame: av.VideoFrame, matrix: np.ndarray | None) -> tuple[int, int]:
    turned = matrix is not None and _is_transposed(matrix)
    return (frame.width, frame.height) if turned else (frame.height, frame.width)


def _duration(container: av.container.InputContainer, stream: av.video.stream.VideoStream) -> float | None:
    """Seconds from the first frame to the end of the last."""
    if stream.duration:
        return float(stream.duration * stream.time_base)
    start = float((stream.start_time or 0) * stream.time_base)
    if tag := stream.metadata.get("DURATION"):
        # Matroska's, counted from the beginning of the file.
        hours, minutes, seconds = tag.split(":")
        return max(0.0, 3600 * int(hours) + 60 * int(minutes) + float(seconds) - start) or None
    if not container.duration or len(container.streams) > 1:
        return None
    total = container.duration / av.time_base
    return total - start if "matroska" in container.format.name else total


def _codec(container: av.container.InputContainer, index: int) -> str:
    """The codec of a stream for which there is no decoder, as FFmpeg names it."""
    level = av.logging.get_level()
    # The library tells it in its log only.
    av.logging.set_level(av.logging.INFO)
    try:
        log = container.dumps_format()
    finally:
        av.logging.set_level(level)
    found = re.search(rf"Stream #0:{index}\b[^\n]*Video: ([^,\n]+)", log)
    return found[1] if found else "(unknown)"


def _notes(name: str, frame: av.VideoFrame, stream: av.video.stream.VideoStream, *, interlaced: bool) -> Iterator[str]:
    if interlaced:
        yield f"{name} is interlaced: its frames are deinterlaced (bwdif), and finest lines lose some detail"
    if transfer := _HDR_TRANSFERS.get(frame.color_trc):
        yield (
            f"{name} is HDR ({transfer}): its frames are reduced to 8 bits without tone mapping, which makes them "
            "look pale; tone-map it beforehand if the result suffers"
        )
    ratio = stream.sample_aspect_ratio
    if ratio and ratio != 1:
        yield (
            f"{name}: its pixels are not square ({ratio.numerator}:{ratio.denominator}) and are used as they are "
            "stored; stretch it beforehand with ffmpeg -i INPUT -vf scale=iw*sar:ih,setsar=1 OUTPUT"
        )
