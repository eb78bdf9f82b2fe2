"""Frames of a folder or a video, read one at a time."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.errors import InputError, MissingInput, disk_errors

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
SEVEN_SCENES_COLOUR = (".color.png", ".color.jpg")


class SourceFrame(NamedTuple):
    """One frame of a source.

    Attributes:
      name: file name without suffix, or `frame-000123` with the position in the video.
      timestamp: seconds from the video's start (position over frame rate); for folders, which know no time, the
        position in the sorted folder.
      image: [H, W, 3] uint8 RGB.
    """

    name: str
    timestamp: float
    image: np.ndarray


class FolderSource:
    """Images of a folder in natural order (`img2` before `img10`).

    A 7-Scenes sequence gives its `*.color.png` or `*.color.jpg` files only; any other folder all its JPEG and
    PNG files. `len` is the number of frames; a frame's file is read when iteration reaches it.

    Args:
      path: the folder.
      stride: take every `stride`-th image.
      max_frames: stop after so many.

    Raises:
      FileNotFoundError: no image in the folder.
      ValueError: while iterating, an image cannot be read, or differs in size from the first.
    """

    def __init__(self, path: Path, *, stride: int = 1, max_frames: int | None = None) -> None:
        _check_sampling(stride, max_frames)
        self.path = path
        with disk_errors(path):
            files = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
        images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
        if not images:
            raise MissingInput(
                f"no image in {path}: expected {', '.join('*' + s for s in IMAGE_SUFFIXES)} files, found "
                f"{len(files)} other files; give the folder that holds the images themselves"
            )
        colour = [file for file in images if file.name.lower().endswith(SEVEN_SCENES_COLOUR)]
        ordered = sorted(colour or images, key=_natural_order)
        names = [_stem(file.name) for file in ordered]
        if len(set(names)) < len(names):
            # 1.jpg beside 1.png: results are named after frames, so that names must differ.
            names = [file.name for file in ordered]
        listing = [
            (float(position), name, file) for position, (name, file) in enumerate(zip(names, ordered, strict=True))
        ]
        self._frames = listing[::stride][:max_frames]

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def expected_frames(self) -> int:
        """Number of frames, for progress bars."""
        return len(self)

    def __iter__(self) -> Iterator[SourceFrame]:
        return (load() for load in self.loaders())

    def loaders(self) -> Iterator[Callable[[], SourceFrame]]:
        """What reads each frame, in order. Loaders may be called in any thread and at the same time."""
        first = self._load(self._frames[0])
        shape = first.image.shape
        yield partial(_itself, first)
        del first
        for entry in self._frames[1:]:
            yield partial(self._load, entry, shape)

    def _load(self, entry: tuple[float, str, Path], shape: tuple[int, ...] | None = None) -> SourceFrame:
        """The frame of an entry; its image has the `shape` of the first."""
        timestamp, name, file = entry
        with disk_errors(file):
            image = read_rgb(file)
        if shape is not None and image.shape != shape:
            raise InputError(
                f"{file} is {_size(image.shape)} pixels but {self._frames[0][2].name} is {_size(shape)}: all frames "
                "of a sequence need one size; resize them or put them into folders of their own"
            )
        return SourceFrame(name, timestamp, image)


class VideoSource:
    """Frames of a video file that OpenCV can decode, decoded as needed.

    The number of frames is known only after decoding (headers lie), so there is no `len`.

    Args:
      path: the video file.
      stride: take every `stride`-th frame.
      max_frames: stop after so many.

    Raises:
      ValueError: the file cannot be opened as a video; while iterating, no frame can be decoded.
    """

    def __init__(self, path: Path, *, stride: int = 1, max_frames: int | None = None) -> None:
        _check_sampling(stride, max_frames)
        self.path, self._stride, self._max_frames = path, stride, max_frames
        capture = self._open()
        self._announced = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        # Without a frame rate time stamps count frames, as they do for folders.
        self._rate = rate if np.isfinite(rate) and rate > 0 else 1.0
        capture.release()

    @property
    def expected_frames(self) -> int | None:
        """Number of frames by the file's header, for progress bars; None if it names none."""
        if not self._announced:
            return self._max_frames
        sampled = -(-self._announced // self._stride)
        return sampled if self._max_frames is None else min(sampled, self._max_frames)

    def __iter__(self) -> Iterator[SourceFrame]:
        return (load() for load in self.loaders())

    def loaders(self) -> Iterator[Callable[[], SourceFrame]]:
        """What finishes each frame, in order; the iteration itself decodes, which a video allows one by one only."""
        capture = self._open()
        position = taken = 0
        try:
            while self._max_frames is None or taken < self._max_frames:
                if not capture.grab():
                    self._check_end(position)
                    return
                if position % self._stride == 0:
                    decoded, image = capture.retrieve()
                    if not decoded:
                        raise InputError(f"{self.path}: frame {position} cannot be decoded; re-encode the video")
                    yield partial(self._frame, position, image)
                    taken += 1
                position += 1
        finally:
            capture.release()

    def _frame(self, position: int, image: np.ndarray) -> SourceFrame:
        rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return SourceFrame(f"frame-{position:06d}", position / self._rate, rgb)

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise InputError(
                f"{self.path} cannot be opened as a video: expected a file that OpenCV decodes (mp4, avi, mkv, "
                "webm, …) or a folder of images; re-encode it, for example to H.264 mp4"
            )
        return capture

    def _check_end(self, decoded: int) -> None:
        if decoded == 0:
            raise InputError(f"{self.path} holds no frame that can be decoded; re-encode the video")
        # Headers are often off by a frame or two; more is missing when a file is damaged or cut short.
        if decoded < 0.99 * self._announced - 2:
            warnings.warn(
                f"{self.path} ends early: {decoded} frames decoded, its header announces {self._announced}",
                stacklevel=3,
            )


Source = FolderSource | VideoSource


def open_source(path: str | Path, *, stride: int = 1, max_frames: int | None = None) -> Source:
    """A folder of images or a video as an iterable of `SourceFrame`, read lazily; every `iter` starts anew.

    Args:
      path: folder or video file.
      stride: take every `stride`-th frame.
      max_frames: stop after so many.

    Raises:
      FileNotFoundError: nothing is there, or the folder holds no image.
      ValueError: the file is no video, or a parameter is out of range.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise MissingInput(f"{path} does not exist: expected a folder of images or a video file")
    if path.is_dir():
        return FolderSource(path, stride=stride, max_frames=max_frames)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"{path} is a single image: give the folder that holds the sequence, or a video")
    return VideoSource(path, stride=stride, max_frames=max_frames)


def _itself(frame: SourceFrame) -> SourceFrame:
    return frame


def _check_sampling(stride: int, max_frames: int | None) -> None:
    if stride < 1:
        raise InputError(f"stride must be at least 1, got {stride}")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"max_frames must be at least 1, got {max_frames}")


def _natural_order(file: Path) -> tuple[list[tuple[int, int, str]], str]:
    parts = re.split(r"(\d+)", file.name.lower())
    # Upper and lower case of one name still need an order of their own.
    return [(1, int(p), "") if p.isdecimal() else (0, 0, p) for p in parts], file.name


def _stem(name: str) -> str:
    lower = name.lower()
    for suffix in (*SEVEN_SCENES_COLOUR, *IMAGE_SUFFIXES):
        if lower.endswith(suffix):
            return name[: -len(suffix)]
    return name


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
