"""Frames of a video file."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.sources.source import Source, SourceFrame, SourceOptions, fingerprint


class VideoSource(Source):
    """Frames of a video file that OpenCV can decode, decoded as needed.

    The number of frames is known only after decoding (headers lie), so there is no `len`.

    Args:
      path: the video file.
      options: which frames are taken.

    Raises:
      ValueError: the file cannot be opened as a video; while iterating, no frame can be decoded.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        super().__init__(path, options)
        self._stride, self._max_frames = options.stride, options.max_frames
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

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(H, W) of the frames."""
        return None

    def fingerprint(self, count: int) -> str:
        """Digest of options and file."""
        return fingerprint(self.options, [self.path])

    def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
        """See `Source.loaders`; the iteration itself decodes, which a video allows one by one only."""
        return islice(self._loaders(), first, None)

    def _loaders(self) -> Iterator[Callable[[], SourceFrame | None]]:
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
