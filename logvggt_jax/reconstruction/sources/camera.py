"""Pictures of a camera that is connected, by OpenCV."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import cv2

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.sources.decoding import Picture
from logvggt_jax.reconstruction.sources.opencv_messages import quiet

# After so many failures in a row a camera counts as gone; while it warms up a few fail.
_MOST_FAILURES = 64


class Camera:
    """See `PictureStream`; a picture's time is that at which it comes.

    Args:
      number: of the camera, as the system counts them.
      name: what messages call it.
    """

    def __init__(self, number: int, name: str) -> None:
        self._number, self._name = number, name

    def pictures(self) -> Iterator[Picture]:
        """See `PictureStream.pictures`."""
        with quiet():
            capture = cv2.VideoCapture(self._number, cv2.CAP_ANY)
        if not capture.isOpened():
            raise InputError(f"{self._name} cannot be opened: is it connected, free, and allowed to be used?")
        failures = 0
        try:
            while failures < _MOST_FAILURES:
                with quiet():
                    read, image = capture.retrieve() if capture.grab() else (False, None)
                if not read or image is None or not image.size:
                    failures += 1
                    continue
                failures = 0
                convert = partial(cv2.cvtColor, image, cv2.COLOR_BGR2RGB)
                yield Picture(time.monotonic(), image.shape[:2], convert)
        finally:
            capture.release()
