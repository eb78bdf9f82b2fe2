"""Decoding of videos by FFmpeg's libraries through PyAV."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator
from functools import partial

import av
import av.error
import av.format
import av.logging
import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.sources.decoding import CodecChange, Damage, Picture, VideoHeader
from logvggt_jax.reconstruction.sources.deinterlacing import Deinterlacer, is_interlaced
from logvggt_jax.reconstruction.sources.h264_frame_numbers import FrameNumbers
from logvggt_jax.reconstruction.sources.jpeg_scans import holds_scan
from logvggt_jax.reconstruction.sources.missing_frames import MissingFrames
from logvggt_jax.reconstruction.sources.mpeg_picture_numbers import PictureNumbers
from logvggt_jax.reconstruction.sources.orientation import matrix_of, noted_orientation, shown_size, turn
from logvggt_jax.reconstruction.sources.pyav_header import (
    STORE_DECODING_TIMES,
    DisplayMatrices,
    PacketNotes,
    average_rate,
    display_matrix,
    duration,
    moving_streams,
    notes_on,
    stated_codec,
)
from logvggt_jax.reconstruction.sources.sampling import likely_frames
from logvggt_jax.reconstruction.sources.video_notes import begins_late

# From release 19 on, tags that are not UTF-8 are always read so.
_TAGS = {"metadata_errors": "replace"} if av.__version__.startswith("18.") else {}
# Text and single images, which FFmpeg would show as videos of one frame.
_NO_VIDEOS = ("image2", "tty", "bin", "xbin", "adf", "idf")
# Formats that state their duration; FFmpeg guesses that of others.
_STATE_DURATION = ("mov", "matroska", "avi", "flv", "asf", "mxf")
# Errors in a row after which a file that cannot be read on counts as ended.
_MOST_READ_ERRORS = 16
_NO_PICTURE = "holds no picture"
# Some formats mark no key frames: after so many packets the first that decodes begins the video.
_LONGEST_LEAD = 300
# Pixels above which frames are decoded side by side.
_LARGE = 1920 * 1088
# Codecs of which every packet shows a frame of its own, but for those of interlaced material and for empty ones, which
# stand for no change. A decoder may drop a damaged packet of theirs without an error. The last two decode AV1.
_FRAME_A_PACKET = ("mpeg4", "h264", "hevc", "mjpeg", "mpeg1video", "mpeg2video", "av1", "libdav1d")
_EMPTY_PACKET = 8
_OF_MPEG = ("mpeg1video", "mpeg2video")
# Codecs of which a packet that ends too soon gives a picture that is half grey, unless any error is to be one.
_EASILY_PLEASED = ("mjpeg",)
# Codecs of which a packet is a picture as a camera writes it, and gives its frame at once.
_OF_CAMERAS = ("mjpeg",)
# The packet that is said to be incomplete is the last before the gap, or the one before that.
_AHEAD = 2
# Packets within which a stream that shows its frames in another order than it holds them does so.
_MOST_UNTIL_REORDERED = 48


class PyAVDecoder:
    """See `VideoDecoder`.

    Args:
      url: what FFmpeg opens.
      name: what messages call it.
      timeout: seconds to wait for a network stream; None for files.
    """

    def __init__(self, url: str, name: str, timeout: float | None = None) -> None:
        self._url, self._name, self._timeout = url, name, timeout
        # Packets before the first key frame, and the earliest of their time stamps.
        self._lead = 0
        self._lead_begins: int | None = None
        # Some writers number packets as they are stored, though their frames are shown in another order.
        self._numbered_as_stored = False

    def header(self) -> VideoHeader:
        """See `VideoDecoder.header`."""
        self._numbered_as_stored = self._is_numbered_as_stored()
        with self._open() as container:
            stream = self._stream(container)
            frame = next((frame for _, frame in self._decode(container, stream) if frame is not None), None)
            if frame is None:
                codec = stream.codec_context.codec.long_name
                raise InputError(f"{self._name} holds no frame that can be decoded ({codec}); re-encode the video")
            rate, stated = average_rate(container, stream), stream.frames or None
            seconds = duration(container, stream, frame.pts if self._lead_begins is None else self._lead_begins)
            if stated is not None and stated > container.size:
                # A recorder that was cut off, or wrote to a pipe, never came to fill in its header.
                seconds = stated = None
            frames = likely_frames(stated, seconds, float(rate) if rate else None)
            return VideoHeader(
                size=shown_size((frame.height, frame.width), display_matrix(frame, stream)),
                rate=float(rate) if rate else None,
                frames=frames,
                # The first part of a file in fragments states its own frames only.
                announced=stated if stated is None or frames is None or frames <= stated else None,
                seconds=seconds if container.format.name.startswith(_STATE_DURATION) else None,
                notes=(*notes_on(self._name, container, stream, frame), *self._begins_late()),
                lead=self._lead,
                lead_seconds=self._lead_seconds(frame, stream),
            )

    def pictures(self) -> Iterator[Picture | Damage | CodecChange]:
        """See `VideoDecoder.pictures`."""
        with self._open() as container:
            stream = self._stream(container)
            deinterlacer, matrices = Deinterlacer(stream, self._name), DisplayMatrices(stream)
            for instead, frame in self._decode(container, stream):
                if frame is not None:
                    ready = deinterlacer.push(frame)
                else:
                    # What was pushed before is shown before.
                    ready = deinterlacer.drain()
                for decoded, whole in ready:
                    yield self._picture(decoded, whole, matrices.of(decoded), stream)
                if instead is not None:
                    yield instead
            for decoded, whole in deinterlacer.drain():
                yield self._picture(decoded, whole, matrices.of(decoded), stream)

    def _picture(
        self,
        decoded: av.VideoFrame,
        whole: av.VideoFrame,
        matrix: np.ndarray | None,
        stream: av.video.stream.VideoStream,
    ) -> Picture:
        # Filters pass on neither.
        whole.colorspace, whole.color_range = decoded.colorspace, decoded.color_range
        return Picture(
            seconds=None if decoded.pts is None else float(decoded.pts * stream.time_base),
            size=shown_size((decoded.height, decoded.width), matrix),
            convert=partial(self._convert, whole, matrix),
            damaged=decoded.is_corrupt,
            lasts=float(decoded.duration * stream.time_base) if decoded.duration else None,
            alone=decoded.key_frame,
            follows_loss=decoded.opaque is not None and decoded.opaque.follows_loss,
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
        return rgb if matrix is None else turn(rgb, matrix)

    def _open(self) -> av.container.InputContainer:
        options = {"rtsp_transport": "tcp"} if self._url.startswith("rtsp") else {}
        try:
            return av.open(self._url, options=options, timeout=self._timeout, **_TAGS)
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
        streams = moving_streams(container)
        if not streams:
            kinds = sorted({stream.type for stream in container.streams} - {"video"})
            raise InputError(
                f"{self._name} holds no video stream, only {' and '.join(kinds) or 'nothing'}: give the file that "
                "holds the pictures"
            )
        best = container.streams.best("video")
        stream = best if best in streams else streams[0]
        if stream.codec_context is None:
            codec = stated_codec(container, stream.index)
            raise InputError(
                f"{self._name}: its codec {codec} cannot be decoded by the FFmpeg that PyAV brings; re-encode it, for "
                "example to H.264 mp4"
            )
        if stream.codec_context.name in _EASILY_PLEASED:
            stream.codec_context.options = {"err_detect": "explode"}
        # Threads within a frame lose nothing when a packet is damaged, but for H.264's mark of frames that are guessed
        # in part. With threads over frames, which large pictures need, the library drops what follows a damaged packet
        # among the last few of the file.
        if stream.width * stream.height > _LARGE:
            stream.thread_type = "AUTO"
        elif stream.codec_context.name == "h264":
            stream.thread_type = "NONE"
        return stream

    def _decode(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream
    ) -> Iterator[tuple[Damage | CodecChange | None, av.VideoFrame | None]]:
        """Frames in the order in which they are shown, with what is missing between them."""
        missing = MissingFrames(stream.time_base)
        self._lead, self._lead_begins = 0, None
        started, key = False, None  # the time stamp of the first key frame; what is shown before refers to lost frames
        joined, last = False, -math.inf  # whether time goes back, as where recordings are joined
        # Of Matroska the library works out when packets are decoded, which goes back where one is missing.
        highest, states_decoding = -math.inf, "matroska" not in container.format.name
        numbers: FrameNumbers | PictureNumbers | None = None
        if stream.codec_context.name == "h264":
            numbers = FrameNumbers(stream.codec_context.extradata or b"")
        elif stream.codec_context.name in _OF_MPEG:
            numbers = PictureNumbers()
        after_loss: set[int | None] = set()  # time stamps of frames before which some are missing
        empty: set[int | None] = set()  # and of those that hold no picture
        each = False  # whether every packet is known to show a frame of its own
        for packet, before_key in self._before_what(container, stream):
            if isinstance(packet, CodecChange):
                yield packet, None
                return
            if isinstance(packet, str):
                missing.fail(packet)
                continue
            # Frames before the first key frame refer to some that are not there: decoders show them grey.
            started = started or packet.is_keyframe or self._lead == _LONGEST_LEAD or not packet.size
            if not started:
                self._lead += 1
                stamps = [stamp for stamp in (self._lead_begins, packet.pts) if stamp is not None]
                self._lead_begins = min(stamps, default=None)
                continue
            if packet.dts is not None:
                joined, last = joined or (packet.dts < last and states_decoding), packet.dts
            if packet.pts is not None:
                joined, highest = joined or (packet.is_keyframe and packet.pts < highest), max(highest, packet.pts)
            key = packet.pts if key is None else key
            holds_frame = packet.size > (0 if self._numbered_as_stored else _EMPTY_PACKET)
            if holds_frame and packet.pts is not None and not packet.is_discard:
                missing.expect(packet.pts)
            # Television's packets are counted; where recordings are joined the count begins anew, with a key frame.
            lossy = packet.is_corrupt and not before_key
            if numbers is not None and packet.size:
                lossy = numbers.follows_loss(bytes(packet), packet.is_keyframe) or lossy
            if lossy:
                after_loss.add(packet.pts)
            if packet.size and stream.codec_context.name in _OF_CAMERAS and not holds_scan(bytes(packet)):
                empty.add(packet.pts)
            try:
                frames = packet.decode()
            except av.error.EOFError:
                frames = []
            except av.FFmpegError as error:
                frames = []
                if packet.size and packet.pts is None:
                    yield Damage(None, str(error.strerror)), None
                else:
                    missing.fail(str(error.strerror))
            noted = matrix_of(noted_orientation(bytes(packet))) if stream.codec_context.name in _OF_CAMERAS else None
            for frame in frames:
                if frame.pts in empty:
                    if frame.pts is None:
                        yield Damage(None, _NO_PICTURE), None
                    else:
                        missing.fail(_NO_PICTURE)
                    continue
                frame.opaque = PacketNotes(noted, frame.pts in after_loss)
                after_loss.discard(frame.pts)
                if self._numbered_as_stored:
                    yield from ((damage, None) for damage in missing.failures())
                    frame.pts = missing.take_next()
                elif frame.pts is not None:
                    each = stream.codec_context.name in _FRAME_A_PACKET and not is_interlaced(frame, stream)
                    since = key if each and not joined else None
                    yield from ((damage, None) for damage in missing.before(frame.pts, since))
                yield None, frame
            empty.discard(None)
        if stream.width * stream.height > _LARGE:
            missing.fail_all("cannot be decoded")
        elif each and not joined:
            yield from ((damage, None) for damage in missing.before(math.inf, key))
        yield from ((damage, None) for damage in missing.failures())

    def _lead_seconds(self, first: av.VideoFrame, stream: av.video.stream.VideoStream) -> float:
        if self._lead_begins is None or first.pts is None:
            return 0.0
        return float(max(0, first.pts - self._lead_begins) * stream.time_base)

    def _begins_late(self) -> Iterator[str]:
        if self._lead:
            yield begins_late(self._name, self._lead)

    def _is_numbered_as_stored(self) -> bool:
        """Whether the packets' time stamps only grow, and the frames' do not."""
        with self._open() as container:
            stream = self._stream(container)
            if not stream.codec_context.has_b_frames:
                return False
            stored = shown = -math.inf
            for packet in itertools.islice(self._packets(container, stream), _MOST_UNTIL_REORDERED):
                if not isinstance(packet, av.Packet) or (packet.pts is not None and packet.pts < stored):
                    return False
                stored = stored if packet.pts is None else packet.pts
                try:
                    stamps = [frame.pts for frame in packet.decode() if frame.pts is not None]
                except av.FFmpegError:
                    continue
                for stamp in stamps:
                    if stamp < shown:
                        return True
                    shown = stamp
        return False

    def _before_what(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream
    ) -> Iterator[tuple[av.Packet | str | CodecChange, bool]]:
        """Packets, and whether one of the next two has a key frame; a network's are not waited for."""
        following: deque[av.Packet | str | CodecChange] = deque()
        for packet in self._packets(container, stream):
            following.append(packet)
            if len(following) > _AHEAD or self._timeout is not None:
                yield following.popleft(), any(isinstance(each, av.Packet) and each.is_keyframe for each in following)
        while following:
            yield following.popleft(), False

    def _packets(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream
    ) -> Iterator[av.Packet | str | CodecChange]:
        """Packets, an empty one at the end, even where that is a change of the codec; a reason where reading fails."""
        errors, codec = 0, self._codec(container, stream)
        empty = av.Packet()
        empty.stream = stream
        while errors < _MOST_READ_ERRORS:
            try:
                for packet in container.demux(stream):
                    if packet.is_keyframe and (now := self._codec(container, stream)) != codec:
                        yield empty
                        yield CodecChange(None, codec, now)
                        return
                    if container.format.name in STORE_DECODING_TIMES:
                        packet.pts = packet.dts
                    yield packet
                    errors = 0
                # Of some codecs no key frame is known as one while those of another are looked for.
                if (now := self._codec(container, stream)) != codec:
                    yield CodecChange(None, codec, now)
                return
            except IndexError:
                # PyAV stumbles at the end over streams that appeared on the way, as in damaged transport streams.
                break
            except av.FFmpegError as error:
                errors += 1
                if errors == 1:
                    yield f"cannot be read: {error.strerror}"
                if self._timeout is not None:
                    break
        # The decoder still holds frames.
        yield empty

    def _codec(self, container: av.container.InputContainer, stream: av.video.stream.VideoStream) -> str:
        """Its name, which only the streams of television are known to change on their way."""
        if container.format.name != "mpegts":
            return stream.codec_context.name
        name = stated_codec(container, stream.index).partition(" ")[0]
        # The one decoder takes either, and the format has one name for both.
        return "mpeg2video" if name == "mpeg1video" else name
