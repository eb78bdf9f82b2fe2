"""What a source of frames is: the frames, which of them are taken, and what is said about the others."""

from __future__ import annotations

import abc
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.sources.masks import Masks

SIZE_MISMATCH = ("error", "crop", "skip")


class SourceFrame(NamedTuple):
    """One frame of a source.

    Attributes:
      name: file name without suffix, or `frame-000123` with the position in the video.
      timestamp: seconds from the video's start; for images the time that their names tell, or else the position in
        the sorted folder.
      image: [H, W, 3] uint8 RGB.
      focal_length: pixels of the image, as the camera noted it; None where it is not known.
      mask: [H, W] bool, True where the image counts; None for a source without masks.
    """

    name: str
    timestamp: float
    image: np.ndarray
    focal_length: float | None = None
    mask: np.ndarray | None = None


class SkippedFrame(NamedTuple):
    """A frame that could not be read: its name, and why in one line."""

    name: str
    reason: str


@dataclasses.dataclass(frozen=True)
class SourceOptions:
    """Which frames of a source are taken.

    Attributes:
      stride: take every n-th frame.
      max_frames: stop after so many; None for all.
      fps: take at most so many frames a second, by their time stamps; None for all.
      start, end: seconds of the video; None for its beginning and end.
      pattern: glob that names of image files have to match; None for all.
      size_mismatch: what happens to images of several sizes: `error`, `crop` (all are cut from their centre to the
        smallest height and the smallest width) or `skip` (the most frequent size stays). As `pattern` not for videos.
      strict: a frame that cannot be read is an error. Otherwise it is left out and listed.
      most_broken: the share of the frames that may be left out so; two always may.
    """

    stride: int = 1
    max_frames: int | None = None
    fps: float | None = None
    start: float | None = None
    end: float | None = None
    pattern: str | None = None
    size_mismatch: str = "error"
    strict: bool = False
    most_broken: float = 0.05

    def __post_init__(self) -> None:
        for name in ("stride", "max_frames"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} must be at least 1, got {value}")
        if self.fps is not None and not 0 < self.fps < float("inf"):
            raise InputError(f"fps must be above 0, got {self.fps}")
        if self.end is not None and not self.end > 0:
            raise InputError(f"end must be above 0 s, got {self.end} s")
        if self.end == float("inf"):
            raise InputError("end must be finite: leave it out to take all frames")
        if not 0 <= (self.start or 0.0) < float("inf"):
            raise InputError(f"start must be at least 0 s and finite, got {self.start} s")
        if self.end is not None and (self.start or 0.0) >= self.end:
            raise InputError(f"start must lie before the end ({self.end} s), got {self.start} s")
        if self.size_mismatch not in SIZE_MISMATCH:
            raise InputError(f"size_mismatch must be one of {', '.join(SIZE_MISMATCH)}, got {self.size_mismatch!r}")

    def too_many_broken(self, broken: int, total: int) -> bool:
        """Whether so many of the frames are more than may be left out."""
        return broken > max(2, self.most_broken * total)


class Source(abc.ABC):
    """Frames in order. Everything that headers say is checked when it is opened; pixels are read as they are needed.

    Attributes:
      path: folder or file.
      name: what messages call it; without the password that an address may hold.
      address: what opens it again, a path or a glob; None for a camera or a network stream, whose frames are gone.
      options: which frames are taken.
      masks: of the frames; None where all pixels count. They are no part of `fingerprint`, and have one of their own.
      notes: what the user should know before the work begins, one line each: what is left out, and why.
      is_cut: whether frames are parts of larger images.
      is_timed: whether time stamps are seconds; else they are positions.
      skipped: frames that could not be read, filled when the source is opened and while frames are loaded.
    """

    def __init__(self, path: Path, options: SourceOptions, masks: Masks | None = None) -> None:
        self.path, self.options, self.masks = path, options, masks
        self.name = str(path)
        self.address: Path | None = path
        self.notes: list[str] = []
        self.skipped: list[SkippedFrame] = []
        self.is_cut = False
        self.is_timed = True

    def __iter__(self) -> Iterator[SourceFrame]:
        """The frames that can be read, one at a time."""
        return (frame for load in self.loaders() if (frame := load()) is not None)

    @property
    @abc.abstractmethod
    def expected_frames(self) -> int | None:
        """Number of frames as far as it is known before they are read; None where it is not."""

    @property
    @abc.abstractmethod
    def image_size(self) -> tuple[int, int] | None:
        """(H, W) of the frames as they will be handed out; None where it is known with the first frame only."""

    def files(self) -> Iterator[Path]:
        """What is read of the disk: pictures or a video, and masks."""
        if self.address is not None:
            yield self.path
        if self.masks is not None:
            yield from self.masks.files()

    @abc.abstractmethod
    def fingerprint(self, count: int) -> str:
        """Digest of what decides the first `count` loaders' frames: options, and names, sizes and times of change of
        their files, and after a blank the library that decodes, where there are several. More frames may follow than
        last time."""

    @abc.abstractmethod
    def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
        """What reads each frame, in order, from the loader number `first` on; every call begins anew.

        Loaders may be called in any thread and at the same time. A loader gives None for a frame that could not be
        read and is left out; an error ends the sequence.
        """


def fingerprint(options: SourceOptions, files: Sequence[Path]) -> str:
    """Digest of options and files, see `Source.fingerprint`."""
    stated = [(str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    # Where a sequence ends says nothing of the frames before.
    text = json.dumps([{**dataclasses.asdict(options), "max_frames": None, "end": None}, stated])
    return hashlib.blake2b(text.encode(errors="surrogateescape"), digest_size=16).hexdigest()
