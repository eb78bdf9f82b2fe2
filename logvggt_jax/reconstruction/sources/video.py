"""Frames of a video file, of a camera, or of a network stream."""

from __future__ import annotations

import re
import secrets
import stat
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from logvggt_jax.errors import InputError, disk_errors, install_line
from logvggt_jax.frames import same_proportions
from logvggt_jax.reconstruction.sources.alternate_lines import AlternateLines
from logvggt_jax.reconstruction.sources.appended_files import another_follows
from logvggt_jax.reconstruction.sources.camera import Camera
from logvggt_jax.reconstruction.sources.decoding import (
    CodecChange,
    Complaint,
    Damage,
    Picture,
    PictureStream,
    VideoDecoder,
    VideoHeader,
)
from logvggt_jax.reconstruction.sources.gif_blocks import breaks_off
from logvggt_jax.reconstruction.sources.listing import some
from logvggt_jax.reconstruction.sources.masks import Masked, Masks
from logvggt_jax.reconstruction.sources.matroska_track import lacks_end
from logvggt_jax.reconstruction.sources.media_boxes import boxes
from logvggt_jax.reconstruction.sources.opencv_decoder import OpenCVDecoder
from logvggt_jax.reconstruction.sources.pauses import Pauses
from logvggt_jax.reconstruction.sources.sampling import FrameClock, FrameSelection, expected_frames
from logvggt_jax.reconstruction.sources.source import (
    SkippedFrame,
    Source,
    SourceFrame,
    SourceOptions,
    fingerprint,
)
from logvggt_jax.reconstruction.sources.video_notes import looks_interlaced
from logvggt_jax.reconstruction.sources.y4m_frames import is_broken

_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "http", "https", "udp", "tcp", "rtp", "srt", "mms")
# A `Path` keeps one slash only.
_STREAM = re.compile(rf"({'|'.join(_SCHEMES)}):/{{1,2}}(?=[^/])", re.IGNORECASE)
_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+):/{1,2}(?=[^/])", re.IGNORECASE)
# The releases of PyAV whose interface is known; the extra `video` asks for one of them.
_PYAV_MAJORS = ("18", "19")
# Seconds until a network stream that says nothing is given up.
_TIMEOUT = 10.0
# Frames a second, for those at the beginning of a stream that come before its clock is known; they are few.
_STREAM_RATE = 30.0
# Brands of files that are built like an mp4 but hold pictures.
_PICTURES = (b"heic", b"heix", b"hevc", b"mif1", b"msf1", b"avif", b"avis")
_LONGEST_PACKET = 192
# Frames by which one may be decoded earlier than it is shown.
_MOST_REORDERED = 16
# Letters of what a library says that are repeated.
_LONGEST_COMPLAINT = 80
# Options that say nothing of a video.
_OF_IMAGES = ("pattern", "size_mismatch")


def is_live(path: str | Path) -> bool:
    """Whether this names a camera (`0`) or a network stream (`rtsp://…`), not a file."""
    text = str(path)
    digits = text.isdecimal() and text.isascii()
    return (digits or _STREAM.match(text) is not None) and not Path(text).exists()


def refuse_address(path: str | Path) -> None:
    """Raises InputError if what is neither a file nor a stream is an address, such as `ftp://…`."""
    if _ADDRESS.match(str(path)):
        address = _without_password(_ADDRESS.sub(r"\1://", str(path), count=1))
        raise InputError(
            f"{address} is neither a file nor an address that is read, which begins with {', '.join(_SCHEMES[:-1])} or "
            f"{_SCHEMES[-1]}: fetch it beforehand"
        )


class VideoSource(Source):
    """Frames of a video, decoded as needed: by PyAV where it is installed, else by OpenCV.

    What OpenCV alone cannot check as PyAV does is refused at once, as are network streams.

    Frames are named after their position in the video, and have the file's own time stamps, in seconds from its first
    frame. They are upright, whole pictures of 8 bits: rotation and mirroring are applied, interlaced ones are
    deinterlaced. Frames that cannot be decoded keep their position, are left out, and are listed in `skipped`.

    How many frames there are is known only after decoding (headers lie), so there is no `len`. Files are opened, and
    their first frame is decoded, at once; cameras and streams when the first loader is asked for.

    Args:
      path: the video file, the number of a camera, or the address of a stream.
      options: which frames are taken.
      masks: one for each frame by its position, or one for all; None for none.

    Raises:
      MissingInput: a frame without a mask, where there are masks.
      InputError: the file cannot be opened as a video, or nothing of it can be decoded; an option is for images; while
        iterating, the size of the pictures or the codec changes, too many frames cannot be decoded, or no frame lies
        where the options ask for it.
    """

    def __init__(self, path: str | Path, options: SourceOptions, masks: Masks | None = None) -> None:
        super().__init__(Path(path), options, masks)
        self._live = is_live(path)
        self.name = _without_password(_address(path))
        self._header: VideoHeader | None = None
        if self._live and str(path).isdecimal():
            self.name = f"camera {path}"
        for option in _OF_IMAGES:
            if getattr(options, option) != getattr(SourceOptions, option):
                raise InputError(f"{option} is for files of images, which {self.name} is not: leave it out")
        if not self._live:
            self.notes += _check_file(self.path)
            decoder = _decoder(self.path, self.name)
            self._decoder: PictureStream = decoder
            self._header = decoder.header()
            self._check_range(self._header)
            self.notes += self._header.notes
            if masks is not None:
                self.notes.append(masks.check_video(self._header.size, from_start=not options.start))
            return
        self.address = None
        if masks is not None:
            masks.check_live()
        if str(path).isdecimal():
            self._decoder = Camera(int(str(path)), self.name)
        else:
            self._decoder = _decoder(_address(path), self.name, _TIMEOUT)

    @property
    def expected_frames(self) -> int | None:
        """Number of frames by the file's header, for progress bars; None if it names none."""
        header = self._header
        if header is None:
            return self.options.max_frames
        frames = None if header.frames is None else max(0, header.frames - header.lead)
        return expected_frames(self.options, frames, header.rate)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(H, W) of the frames as they are shown; None for cameras and streams."""
        return None if self._header is None else self._header.size

    def fingerprint(self, count: int) -> str:
        """Digest of options and file, and the library, as no two give the same pixels.

        A new one each time for cameras and streams, which cannot be resumed.
        """
        if self._live:
            return secrets.token_hex(16)
        with disk_errors(self.path):
            return f"{fingerprint(self.options, [self.path])} {type(self._decoder).__name__}"

    def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
        """See `Source.loaders`.

        The iteration itself decodes, which a video allows one frame after the other only; loaders convert. There is
        none for a frame that cannot be decoded.
        """
        self.skipped.clear()
        header = self._header
        clock, selection = FrameClock(header.rate if header else _STREAM_RATE), FrameSelection(self.options)
        size = header.size if header else None
        taken, guessed, position, seconds, lasts = 0, 0, -1, 0.0, None
        pauses, lines = Pauses(), AlternateLines()
        lost, doubtful = False, 0  # whether a frame is missing since the last that refers to no other
        losses: list[str] = []  # frames before which some are not in the stream
        complaints: dict[int, str] = {}
        explained: set[int] = set()  # positions at which what is complained of comes of frames that are told as missing
        for position, picture in self._numbered(complaints):
            name, seconds = f"frame-{position:06d}", clock.time(picture.seconds)
            if selection.is_over(seconds):
                break
            wanted = selection.wants(position, seconds)
            if isinstance(picture, CodecChange):
                raise InputError(
                    f"{self.name} changes its codec about frame {position}, from {picture.before} to {picture.after}: "
                    "all frames need one; cut it there"
                )
            if header is not None:
                pauses.add(seconds, None if isinstance(picture, Damage) else picture.lasts)
            if isinstance(picture, Damage):
                lost = True
                explained.update(_decoded_about(position))
                if wanted:
                    self._skip(name, picture.reason, taken)
            else:
                size, lasts = size or picture.size, picture.lasts
                if selection.has_begun(seconds) and picture.size != size:
                    self._refuse_size(position, picture.size, size)
                guessed += picture.damaged
                # A camera's or stream's pictures are not converted for nothing, nor are those of a run that goes on.
                if header is not None and not first and lines.wants(position):
                    lines.add(position, picture.convert())
                if picture.follows_loss and not lost:
                    losses.append(name)
                if lost or picture.follows_loss:
                    explained.update(_decoded_about(position))
                lost = (lost or picture.follows_loss) and picture.alone is False
                if wanted:
                    doubtful += lost
                    selection.take(seconds)
                    taken += 1
                    if taken > first:
                        yield partial(self._frame, name, seconds, picture)
                    if taken == self.options.max_frames:
                        break
        else:
            self._check_end(position + 1, seconds, lasts)
        if guessed:
            self._add_note(f"{self.name}: frames with damaged parts, which the decoder filled by guesses: {guessed}")
        if told := {at: text for at, text in complaints.items() if at not in explained}:
            places = some(f"frame-{at:06d}" for at in told)
            self._add_note(
                f"{self.name} is damaged about {places} ({_short(next(iter(told.values())))}): pictures there may be "
                "wrong in parts, or missing"
            )
        if losses:
            self._add_note(
                f"{self.name} lacks frames before {some(losses)}, to which later ones refer, or part of these: it was "
                "recorded or copied with gaps"
            )
        if doubtful:
            self._add_note(
                f"{self.name}: frames between one that is {'missing' if losses else 'left out'} and the next key "
                f"frame, which may lack what it showed: {doubtful}"
            )
        if found := pauses.found():
            places = some(f"{length:.3g} s after frame-{place:06d}" for place, length in found)
            self._add_note(f"{self.name} shows nothing for {places}: the recording was paused, or is damaged there")
        if lines.found():
            self._add_note(looks_interlaced(self.name))
        if not taken:
            raise InputError(
                f"{self.name} gave no frame between {self.options.start or 0:g} s and "
                f"{'its end' if self.options.end is None else f'{self.options.end:g} s'}"
            )

    def _numbered(self, complaints: dict[int, str]) -> Iterator[tuple[int, Picture | Damage | CodecChange]]:
        """What is decoded, with its position; fills in what is complained of by the position of what follows."""
        position = 0
        for each in self._decoder.pictures():
            if isinstance(each, Complaint):
                complaints.setdefault(position, each.text)
            else:
                yield position, each
                position += 1

    def _frame(self, name: str, seconds: float, picture: Picture) -> SourceFrame:
        image = picture.convert()
        if image.dtype != np.uint8 or image.shape != (*picture.size, 3):
            raise InputError(
                f"{self.name}: {name} is {image.dtype} {image.shape} after decoding, expected 8 bits and three "
                "colours; re-encode the video"
            )
        mask = None if self.masks is None else self.masks.read(Masked(name, "", picture.size))
        return SourceFrame(name, seconds, image, mask=mask)

    def _skip(self, name: str, reason: str, taken: int) -> None:
        self.skipped.append(SkippedFrame(name, reason))
        count = len(self.skipped)
        if self.options.strict:
            raise InputError(f"{self.name}: {name} cannot be decoded ({reason}); re-encode the video")
        total = self.expected_frames or taken + count
        if self.options.too_many_broken(count, total):
            raise InputError(
                f"{self.name}: {count} of {total} frames cannot be decoded, up to {name} ({reason}), more than "
                f"{self.options.most_broken:.0%}; copy the video anew or re-encode it"
            )

    def _refuse_size(self, position: int, size: tuple[int, int], first: tuple[int, int]) -> None:
        # One shape scaled to another would be squashed.
        alike = same_proportions(size, first)
        scale = f", or scale all of it with ffmpeg -i INPUT -vf scale={first[1]}:{first[0]} OUTPUT.mp4" if alike else ""
        raise InputError(
            f"{self.name}: frame {position} is {size[1]} x {size[0]} pixels but the video begins with {first[1]} x "
            f"{first[0]}: all frames need one size; cut it there{scale}"
        )

    def _check_range(self, header: VideoHeader) -> None:
        start = self.options.start or 0.0
        seconds = None if header.seconds is None else header.seconds - header.lead_seconds
        if seconds is not None and start >= seconds:
            raise InputError(f"{self.name} lasts {seconds:.3g} s, but start is {start:g} s: choose less")

    def _check_end(self, frames: int, seconds: float, lasts: float | None) -> None:
        """Warns of a file that ends before its header says, and notes where a few frames of it are not shown.

        The last frame, at `seconds`, may be shown for long, as in recordings of a screen.
        """
        header = self._header
        if header is None or not frames:
            return
        step = 1.0 / header.rate if header.rate else 0.0
        # An edited file announces frames that it does not show; its duration does not count them.
        end = seconds + max(step, lasts or 0.0)
        lacks_time = header.seconds is not None and header.lead_seconds + end < 0.99 * header.seconds - 2 * step
        there = frames + header.lead
        after = f" after the {header.lead} frames that are left out" if header.lead else ""
        if header.announced is None:
            short = lacks_time
            told = f"{end:.4g} s decoded{after}, its header announces {header.seconds or 0:.4g} s"
        else:
            short = there < 0.99 * header.announced - 2 and (lacks_time or header.seconds is None)
            told = f"{frames} frames decoded{after}, its header announces {header.announced}"
            if there < header.announced and not short:
                self._add_note(
                    f"{self.name} shows {frames} of the {header.announced} frames in it: it was cut without encoding "
                    "it anew, holds empty ones where nothing changes, or its index is damaged"
                )
        if short:
            warnings.warn(f"{self.name} ends early: {told}", stacklevel=3)

    def _add_note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)


def _decoded_about(position: int) -> range:
    """Positions of frames that may come out while this one is decoded, which may be before it is shown."""
    return range(position - _MOST_REORDERED, position + 1)


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_COMPLAINT else f"{text[:_LONGEST_COMPLAINT]}…"


def _decoder(source: str | Path, name: str, timeout: float | None = None) -> VideoDecoder:
    """PyAV's decoder where a release is installed whose interface is known, else OpenCV's."""
    # FFmpeg takes `a:b.mp4` for a protocol, not so an absolute path.
    url = source if isinstance(source, str) else str(source.absolute())
    try:
        import av
    except ImportError:
        return _without_pyav(url, name, timeout)
    if av.__version__.split(".")[0] not in _PYAV_MAJORS:
        warnings.warn(
            f"PyAV {av.__version__} may have another interface than {' and '.join(_PYAV_MAJORS)}, which are known "
            f"here; OpenCV reads {name} instead: {install_line('video')} brings the right one",
            stacklevel=2,
        )
        return _without_pyav(url, name, timeout)
    from logvggt_jax.reconstruction.sources.pyav_decoder import PyAVDecoder

    return PyAVDecoder(url, name, timeout)


def _without_pyav(url: str, name: str, timeout: float | None) -> OpenCVDecoder:
    if timeout is not None:
        raise InputError(
            f"{name} is a network stream, of which OpenCV alone notices neither all damage nor a change of size: "
            f"{install_line('video')}"
        )
    return OpenCVDecoder(url, name)


def _check_file(path: Path) -> Iterator[str]:
    """Refuses what no library could read as a video, or would wait for without end; tells what none would notice."""
    with disk_errors(path):
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is neither a file nor a folder: give a video file, or the number of a camera")
        if status.st_size == 0:
            raise InputError(f"{path} is empty (0 bytes): copy or record the video anew")
        with path.open("rb") as file:
            if file.read(30)[8:].startswith(b"WEBPVP8X") and file.read(4) == b"ANIM":
                raise InputError(f"{path} is an animated WebP, which cannot be decoded: convert it to mp4 or GIF")
            yield from _check_index(path, file, status.st_size)
            if lacks_end(file):
                yield _broken_off(path)
            if is_broken(file):
                yield f"{path} is damaged, or lacks its end: frames from there on are not read; copy it anew"
            if another_follows(file):
                yield _read_in_part(path, "several")
            file.seek(0)
            if (length := _television_packet(file.read(2 * _LONGEST_PACKET))) and status.st_size % length:
                yield _broken_off(path)
            file.seek(0)
            if file.read(4) == b"GIF8" and breaks_off(file):
                yield (
                    f"{path} lacks its end: the last frame may be half a picture, and those after it are missing; copy "
                    "it anew"
                )


def _television_packet(head: bytes) -> int | None:
    """Bytes of each packet of a transport stream, without or behind a time; None for other files."""
    for length in (188, _LONGEST_PACKET):
        begin = length - 188
        if head[begin::length][:2] == b"\x47\x47":
            return length
    return None


def _check_index(path: Path, file: BinaryIO, size: int) -> Iterator[str]:
    """Refuses an mp4 or mov file that lacks the box `moov`, without which none of it can be decoded; tells of a second
    one, which is not read, though fragments after it are, and of fragments that break off."""
    file.seek(0)
    head = file.read(12)
    if head[4:8] != b"ftyp" or head[8:] in _PICTURES:
        return
    found = list(boxes(file, size))
    kinds = [box.kind for box in found if box.end <= size]
    if b"moov" not in kinds:
        raise InputError(
            f"{path} lacks its index (moov), or part of it: the recording or the copy was broken off; copy it anew, or "
            "restore it with untrunc and a whole video of the same camera"
        )
    # Nothing announces how many fragments there are to be.
    if any(box.kind == b"moof" for box in found) and found[-1].end != size:
        yield _broken_off(path)
    if kinds.count(b"moov") > 1 and b"moof" not in kinds:
        yield _read_in_part(path, str(kinds.count(b"moov")))


def _broken_off(path: Path) -> str:
    return f"{path} lacks its end: the recording or the copy was broken off, and its last frames may be missing"


def _read_in_part(path: Path, count: str) -> str:
    return (
        f"{path} holds {count} videos one after the other, of which the first alone is read; join the original files "
        "with ffmpeg -f concat -i LIST.txt -c copy OUTPUT.mp4"
    )


def _without_password(address: str) -> str:
    return re.sub(r"(?<=://)[^/@]*:[^/@]*@", "", address)


def _address(path: str | Path) -> str:
    """The path as text; a stream's address with both its slashes."""
    return _STREAM.sub(r"\1://", str(path), count=1) if is_live(path) else str(path)
