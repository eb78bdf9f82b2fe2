"""Decoding of videos by OpenCV."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NoReturn

import cv2
import numpy as np

from logvggt_jax.errors import InputError, install_line
from logvggt_jax.reconstruction.sources.containers import (
    AVI,
    FLASH,
    MATROSKA,
    MP4,
    WINDOWS_MEDIA,
    container_of,
)
from logvggt_jax.reconstruction.sources.decoding import CodecChange, Complaint, Damage, Picture, VideoHeader
from logvggt_jax.reconstruction.sources.matroska_track import read_matroska_view
from logvggt_jax.reconstruction.sources.media_info import MediaHeader, media_info_is_there, read_media_header
from logvggt_jax.reconstruction.sources.mp4_track import TrackView, read_mp4_view
from logvggt_jax.reconstruction.sources.opencv_codecs import WITHOUT_HEADER, codec_name, codec_of
from logvggt_jax.reconstruction.sources.opencv_messages import (
    Message,
    captured_messages,
    errors_of_ffmpeg,
    guessed_frames,
    hears_all,
    quiet,
    tells_half_jpeg,
)
from logvggt_jax.reconstruction.sources.orientation import matrix_of, shown_size, turn
from logvggt_jax.reconstruction.sources.packet_follower import PacketFollower, TimeStamps, look_at_times
from logvggt_jax.reconstruction.sources.sampling import likely_frames
from logvggt_jax.reconstruction.sources.video_notes import (
    all_around,
    begins_late,
    high_dynamic_range,
    no_times,
    oblong_pixels,
    several_videos,
)

# OpenCV tells neither why a frame failed nor whether the file has ended: after so many failures in a row it has.
_MOST_FAILURES = 64
# Frames at the beginning whose order is looked at.
_FIRST_FRAMES = 16
# The codec by which FFmpeg draws text as a terminal would.
_TEXT = b"ansi"
# Formats that state how many frames there are; of others OpenCV multiplies duration and rate.
_STATE_FRAMES = (MP4, AVI)
# How FFmpeg calls frames that refer to others, and those of which it does not know.
_REFER = "PB?"
_PYAV = install_line("video")
_UNDECODED, _NO_PICTURE = "cannot be decoded", "holds no picture"


class OpenCVDecoder:
    """See `VideoDecoder`.

    Args:
      file: its absolute path.
      name: what messages call it.
    """

    def __init__(self, file: str, name: str) -> None:
        self._file, self._name = file, name
        self._looked = False
        self._container: str | None = None
        self._view = TrackView()
        self._media: MediaHeader | None = None
        self._matrix: np.ndarray | None = None
        self._times = TimeStamps(exist=True, as_stored=False, begin=0.0)

    def header(self) -> VideoHeader:
        """See `VideoDecoder.header`."""
        self._look_at_file()
        with captured_messages() as said:
            capture = self._open()
            read = any(capture.grab() for _ in range(_MOST_FAILURES))
            image = capture.retrieve()[1] if read else None
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            stated = int(count) if 0 < count <= self._bytes() else None
            begins = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            single = stated is None and not capture.grab()
        codec = codec_name(capture)
        called = _called(codec)
        self._check_converted(said)
        if image is None:
            raise InputError(
                f"{self._name} holds no frame that OpenCV can decode (codec {called}): {_PYAV}, or re-encode it, for "
                "example to H.264 mp4"
            )
        if single or codec == _TEXT:
            kind = "text" if codec == _TEXT else "a single image"
            raise InputError(f"{self._name} is {kind}, not a video: give a video or the folder that holds the images")
        if self._container is None:
            self._refuse_unchecked("a format in which OpenCV does not notice all damage")
        if codec_of(codec) is None:
            self._refuse_unchecked(
                f"a codec ({called}) of which OpenCV does not notice all damage, or a change of size"
            )
        self._check_heard(codec)
        frequency = capture.get(cv2.CAP_PROP_FPS)
        rate = frequency if math.isfinite(frequency) and frequency > 0 else None
        if self._media is not None and self._media.bare:
            # OpenCV tells a default, not what the codec states.
            rate = self._media.rate or rate
        if self._media is not None and self._media.interlaced:
            self._refuse_interlaced()
        follower = self._follower(0.0)
        notes = tuple(self._notes(capture, image.shape[:2], rate, follower))
        matrix = self._turned(follower)
        capture.release()
        follower.close()
        seconds = self._view.seconds or (self._media.seconds if self._media else None)
        if self._container == AVI and seconds is not None:
            seconds -= begins
        if self._container == MATROSKA and seconds is not None:
            seconds -= self._times.begin
        if stated and rate and self._states_seconds():
            seconds = stated / rate - (self._times.begin if self._container == WINDOWS_MEDIA else 0.0)
        if seconds is not None and seconds <= 0:  # of damaged times
            seconds = None
        return VideoHeader(
            size=shown_size(image.shape[:2], matrix),
            rate=rate,
            frames=likely_frames(stated, seconds, rate),
            announced=stated if self._container in _STATE_FRAMES else None,
            seconds=seconds,
            notes=notes,
            lead=follower.lead,
            lead_seconds=follower.lead_seconds,
        )

    def pictures(self) -> Iterator[Picture | Damage | Complaint | CodecChange]:
        """See `VideoDecoder.pictures`."""
        self._look_at_file()
        with captured_messages() as messages:
            capture = self._open()
        said = errors_of_ffmpeg(messages)
        follower = self._follower(capture.get(cv2.CAP_PROP_FPS))
        try:
            yield from self._follow(capture, follower, said)
        finally:
            capture.release()
            follower.close()

    def _follow(
        self, capture: cv2.VideoCapture, follower: PacketFollower, said: list[str]
    ) -> Iterator[Picture | Damage | Complaint | CodecChange]:
        """`said` is what was said of damage when the file was opened."""
        failures = guessed = 0
        last: float | None = None
        before: np.ndarray | None = None
        first_size: tuple[int, int] | None = None
        while failures < _MOST_FAILURES or not follower.is_over(failures):
            with captured_messages() as messages:
                decoded, image = capture.retrieve() if capture.grab() else (False, None)
            said += errors_of_ffmpeg(messages)
            guessed += guessed_frames(messages)
            if not decoded or image is None or not image.size or tells_half_jpeg(messages):
                failures += 1
                if change := follower.codec_change(failures):
                    yield CodecChange(None, *change)
                    return
                continue
            seconds = self._stamp(capture, last, follower)
            refers = chr(int(capture.get(cv2.CAP_PROP_FRAME_TYPE))) in _REFER
            for _ in range(failures):
                follower.fail(_UNDECODED)
            if seconds is None or self._times.as_stored:
                yield from follower.failures()
                ordered = follower.next_in_order()
                seconds = ordered if self._times.as_stored else None
            elif follower.precedes_key_frame(stamp := round(1e6 * seconds), refers):
                failures, said = 0, []
                continue
            else:
                yield from follower.before(stamp)
            if said and not failures:
                yield Complaint(said[0])
            failures, said = 0, []
            if not follower.holds_picture:
                last = seconds
                yield Damage(seconds, _NO_PICTURE)
                continue
            if before is not None and np.array_equal(image, before):
                # Either nothing moves, or the picture was not converted and the buffer holds the one before.
                with captured_messages() as messages:
                    capture.retrieve()
                self._check_converted(messages)
            last, before = seconds, image
            stated = follower.size
            first_size = first_size or stated
            matrix = self._turned(follower)
            size = shown_size(_stored_size(image.shape[:2], stated, first_size), matrix)
            # Some files mark every packet as a key frame's, and of some it is not known which is this frame's.
            alone, follows_loss = not refers and (follower.key or not follower.known), follower.follows_loss
            convert = partial(_convert, image, matrix)
            yield Picture(seconds, size, convert, damaged=guessed > 0, alone=alone, follows_loss=follows_loss)
            guessed = max(0, guessed - 1)
        in_order = self._times.exist and not self._times.as_stored
        yield from follower.rest() if in_order or not follower.reordered else follower.failures()
        if said:
            yield Complaint(said[0])

    def _turned(self, follower: PacketFollower) -> np.ndarray | None:
        """The display matrix of the picture at hand: what its camera noted comes before what the file says of all."""
        noted = matrix_of(follower.orientation)
        return self._matrix if noted is None else noted

    def _notes(
        self, capture: cv2.VideoCapture, size: tuple[int, int], rate: float | None, follower: PacketFollower
    ) -> Iterator[str]:
        media = self._media
        if media is not None and len(media.sizes) > 1:
            names = [f"v:{number}" for number in range(len(media.sizes))]
            read = media.sizes.index(size) if size in media.sizes else 0
            yield several_videos(self._name, media.sizes, names, names[read])
        if not self._times.exist or (media is not None and media.bare):
            yield no_times(self._name, rate or 1.0)
        if self._view.projection is not None:
            yield all_around(self._name, self._view.projection)
        if media is not None and media.transfer is not None:
            yield high_dynamic_range(
                self._name, media.transfer, "turned into 8 bits by OpenCV, which alters their colours"
            )
        width, height = (round(capture.get(each)) for each in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
        if width and height and width != height:
            yield oblong_pixels(self._name, width, height)
        if follower.lead:
            yield begins_late(self._name, follower.lead)

    def _look_at_file(self) -> None:
        """Learns what OpenCV does not tell: how pictures are turned, what their header says, and which times hold."""
        if self._looked:
            return
        self._looked = True
        self._container = container_of(Path(self._file))
        shown: list[int] = []
        with captured_messages():
            capture = self._open()
            while len(shown) < _FIRST_FRAMES and capture.grab():
                shown.append(round(1000 * capture.get(cv2.CAP_PROP_POS_MSEC)))
            capture.release()
        self._times = look_at_times(self._file, shown)
        self._view = read_matroska_view(Path(self._file)) or read_mp4_view(Path(self._file))
        self._media = read_media_header(Path(self._file))
        self._matrix = self._view.matrix
        if self._matrix is None and self._media is not None and self._media.quarter_turns:
            self._matrix = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), self._media.quarter_turns)

    def _follower(self, rate: float) -> PacketFollower:
        return PacketFollower(self._file, rate, timed=self._times.exist, edited=self._view.edited)

    def _check_heard(self, codec: bytes) -> None:
        """Raises InputError where what only FFmpeg or MediaInfo tell would not be noticed."""
        if not hears_all():
            raise InputError(
                f"{self._name} cannot be checked, as the FFmpeg of this OpenCV cannot be asked what it says of damage, "
                f"and of interlaced pictures: {_PYAV}"
            )
        if self._media is None and codec not in WITHOUT_HEADER:
            why = "knows nothing of it" if media_info_is_there() else "is not there for this system"
            raise InputError(
                f"{self._name} cannot be checked for HDR, and for interlacing that only the header tells, as MediaInfo "
                f"{why}: {_PYAV}"
            )

    def _check_converted(self, said: list[Message]) -> None:
        """Raises InputError if OpenCV handed out a buffer into which it could not convert the picture."""
        if any("interlaced to progressive" in message.text for message in said):
            self._refuse_interlaced()

    def _refuse_unchecked(self, kind: str) -> NoReturn:
        raise InputError(f"{self._name} is of {kind}: {_PYAV}, or re-encode it, for example to H.264 mp4")

    def _refuse_interlaced(self) -> NoReturn:
        raise InputError(
            f"{self._name} is interlaced, which OpenCV cannot convert: {_PYAV}, or deinterlace it with "
            "ffmpeg -i INPUT -vf bwdif=send_frame OUTPUT.mp4"
        )

    def _bytes(self) -> int:
        """Size of the file, which has no more frames: headers that were never filled in say more."""
        return Path(self._file).stat().st_size

    def _states_seconds(self) -> bool:
        """Whether the duration that OpenCV knows is that of the video, as the file states it."""
        # Flash states one for sound and pictures together.
        silent = self._media is not None and not self._media.sound
        return self._container == WINDOWS_MEDIA or (self._container == FLASH and silent)

    def _stamp(self, capture: cv2.VideoCapture, last: float | None, follower: PacketFollower) -> float | None:
        if not self._times.exist:
            return None
        seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        # Without a time stamp OpenCV says 0.
        known = seconds != 0 or last is None or follower.begins_part()
        return seconds if known else None

    def _open(self) -> cv2.VideoCapture:
        if re.search("[\ud800-\udfff]", self._file):
            # A name that is no Unicode ends the process.
            raise InputError(f"{self._name!r}: OpenCV cannot open a file of this name: rename it, or {_PYAV}")
        with quiet():
            # What other threads than the one that reads say of damage is not heard.
            capture = cv2.VideoCapture(self._file, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if capture.isOpened():
            if self._matrix is not None:
                capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            return capture
        raise InputError(
            f"{self._name} cannot be opened as a video: expected a file that OpenCV decodes (mp4, avi, mkv, webm, …) "
            f"or a folder of images; {_PYAV} for more formats, or re-encode it, for example to H.264 mp4"
        )


def _stored_size(
    decoded: tuple[int, int], stated: tuple[int, int] | None, first: tuple[int, int] | None
) -> tuple[int, int]:
    """(H, W) before it is turned. OpenCV brings every picture to the size of the first, whatever the packets state."""
    if stated is None or stated == first:
        return decoded
    return stated if decoded == first else stated[::-1]


def _convert(image: np.ndarray, matrix: np.ndarray | None) -> np.ndarray:
    rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return rgb if matrix is None else turn(rgb, matrix)


def _called(codec: bytes) -> str:
    return re.sub(r"[^\w.-]", "", codec.decode("latin-1")) or "unknown"
