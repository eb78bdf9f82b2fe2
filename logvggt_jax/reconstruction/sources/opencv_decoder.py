"""Decoding of videos and cameras by OpenCV."""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from logvggt_jax.errors import InputError, install_line
from logvggt_jax.reconstruction.sources.decoding import Damage, Picture, VideoHeader

# OpenCV tells neither why a frame failed nor whether the file has ended: after so many failures in a row it has.
_MOST_FAILURES = 64
# The codec by which FFmpeg draws text as a terminal would.
_TEXT = "ansi"
_PYAV = install_line("video")


class OpenCVDecoder:
    """See `VideoDecoder`.

    Args:
      source: a file's absolute path, the address of a stream, or the number of a camera.
      name: what messages call it.
      timeout: seconds to wait for a network stream; None for files.
    """

    def __init__(self, source: str | int, name: str, timeout: float | None = None) -> None:
        self._source, self._name, self._timeout = source, name, timeout

    def header(self) -> VideoHeader:
        """See `VideoDecoder.header`."""
        with _captured_stderr() as messages:
            capture = self._open()
            read = any(capture.grab() for _ in range(_MOST_FAILURES))
            image = capture.retrieve()[1] if read else None
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            frames = int(count) if 0 < count <= self._bytes() else None
            single = frames is None and not capture.grab()
            said = messages()
        codec = _fourcc(capture)
        self._check_converted(said)
        if image is None:
            raise InputError(
                f"{self._name} holds no frame that OpenCV can decode (codec {codec}): {_PYAV}, or re-encode it, for "
                "example to H.264 mp4"
            )
        if single or codec == _TEXT:
            kind = "text" if codec == _TEXT else "a single image"
            raise InputError(f"{self._name} is {kind}, not a video: give a video or the folder that holds the images")
        rate = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        return VideoHeader(
            size=image.shape[:2],
            rate=rate if math.isfinite(rate) and rate > 0 else None,
            frames=frames,
            announced=frames if self._states_frames() else None,
            seconds=None,
            notes=(
                f"{self._name} is decoded by OpenCV, which does not notice a change of size within it, interlacing "
                f"that only its header tells, mirroring, HDR, or pixels that are not square: {_PYAV}",
            ),
        )

    def pictures(self) -> Iterator[Picture | Damage]:
        """See `VideoDecoder.pictures`."""
        capture = self._open()
        rate = capture.get(cv2.CAP_PROP_FPS)
        step = 1.0 / rate if math.isfinite(rate) and rate > 0 else math.inf
        # Frames that failed are known by the gaps that they leave.
        failed = in_a_row = 0
        last: float | None = None
        before: np.ndarray | None = None
        try:
            while in_a_row < _MOST_FAILURES:
                asked = time.monotonic()
                with contextlib.nullcontext() if self._timeout is None else _quiet():
                    decoded, image = capture.retrieve() if capture.grab() else (False, None)
                if not decoded or image is None or not image.size:
                    in_a_row += 1
                    # A stream that has fallen silent fails but once in that time.
                    if self._timeout is not None and time.monotonic() - asked >= self._timeout:
                        break
                    continue
                failed, in_a_row = failed + in_a_row, 0
                seconds = self._stamp(capture, last)
                while failed and last is not None and seconds is not None and seconds - last > 1.5 * step:
                    failed, last = failed - 1, last + step
                    yield Damage(last, "cannot be decoded")
                if before is not None and np.array_equal(image, before):
                    # Either nothing moves, or the picture was not converted and the buffer holds the one before.
                    with _captured_stderr() as messages:
                        capture.retrieve()
                        self._check_converted(messages())
                last, before = seconds, image
                yield Picture(seconds, image.shape[:2], partial(_to_rgb, image))
            yield from [Damage(None, "cannot be decoded")] * failed
        finally:
            capture.release()

    def _check_converted(self, said: str) -> None:
        """Raises InputError if OpenCV handed out a buffer into which it could not convert the picture."""
        if "interlaced to progressive" in said:
            raise InputError(
                f"{self._name} is interlaced, which OpenCV cannot convert: {_PYAV}, or deinterlace it with "
                "ffmpeg -i INPUT -vf bwdif=send_frame OUTPUT.mp4"
            )

    def _bytes(self) -> float:
        """Size of the file, which has no more frames: headers that were never filled in say more."""
        if isinstance(self._source, int) or self._timeout is not None:
            return math.inf
        return Path(self._source).stat().st_size

    def _states_frames(self) -> bool:
        """Whether the count is the file's own (mp4, mov, avi); OpenCV multiplies duration and rate elsewhere."""
        if isinstance(self._source, int) or self._timeout is not None:
            return False
        with Path(self._source).open("rb") as file:
            head = file.read(8)
        return head[4:] == b"ftyp" or head[:4] == b"RIFF"

    def _stamp(self, capture: cv2.VideoCapture, last: float | None) -> float | None:
        if isinstance(self._source, int):
            return time.monotonic()
        seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        # Without time stamps OpenCV says 0 every time.
        return None if last is not None and seconds == 0 else seconds

    def _open(self) -> cv2.VideoCapture:
        parameters = []
        if self._timeout is not None:
            milliseconds = round(1000 * self._timeout)
            parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, milliseconds, cv2.CAP_PROP_READ_TIMEOUT_MSEC, milliseconds]
        if re.search("[\ud800-\udfff]", str(self._source)):
            # A name that is no Unicode ends the process.
            raise InputError(f"{self._name!r}: OpenCV cannot open a file of this name: rename it, or {_PYAV}")
        with _quiet():
            capture = cv2.VideoCapture(self._source, cv2.CAP_ANY, parameters)
        if capture.isOpened():
            return capture
        if isinstance(self._source, int):
            raise InputError(f"{self._name} cannot be opened: is it connected, free, and allowed to be used?")
        if self._timeout is not None:
            raise InputError(
                f"{self._name} cannot be opened (waited up to {self._timeout:g} s): check address, network and password"
            )
        raise InputError(
            f"{self._name} cannot be opened as a video: expected a file that OpenCV decodes (mp4, avi, mkv, webm, …) "
            f"or a folder of images; {_PYAV} for more formats, or re-encode it, for example to H.264 mp4"
        )


def _to_rgb(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _fourcc(capture: cv2.VideoCapture) -> str:
    code = int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
    return re.sub(r"[^\w.-]", "", code.to_bytes(4, "little").decode("latin-1")) or "unknown"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without OpenCV's warnings: an error says the same."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextlib.contextmanager
def _captured_stderr() -> Iterator[Callable[[], str]]:
    """What libraries print to standard error in the block: OpenCV hands out errors in no other way.

    Gives a function that returns what has been printed so far; nothing of it reaches the terminal.
    """
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with tempfile.TemporaryFile() as file:
            os.dup2(file.fileno(), 2)
            try:

                def printed() -> str:
                    file.seek(0)
                    return file.read().decode(errors="replace")

                yield printed
            finally:
                os.dup2(kept, 2)
    finally:
        os.close(kept)
