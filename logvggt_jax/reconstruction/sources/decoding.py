"""What a library that decodes videos is asked for: a header, and pictures in the order in which they are shown."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np


@dataclasses.dataclass(frozen=True)
class VideoHeader:
    """What is known of a video before all of it is decoded.

    Attributes:
      size: (H, W) of the pictures as they are shown, after rotation.
      rate: frames a second on average; None where the file does not say.
      frames: number of frames as far as it can be told; None where it cannot.
      announced: number of frames that the file itself states; None where it does not.
      seconds: duration of the video stream that the file states; None where it does not.
      notes: what the user should know, one line each.
      lead: of those frames, the ones before the first key frame, which are left out.
      lead_seconds: of that duration, how long these are shown.
    """

    size: tuple[int, int]
    rate: float | None
    frames: int | None
    announced: int | None
    seconds: float | None
    notes: tuple[str, ...] = ()
    lead: int = 0
    lead_seconds: float = 0.0


class Picture(NamedTuple):
    """A decoded frame.

    Attributes:
      seconds: presentation time stamp; None where there is none.
      size: (H, W) as it is shown, after rotation.
      convert: gives the picture as [H, W, 3] uint8 RGB, in any thread.
      damaged: the decoder had to guess parts of it.
      lasts: seconds for which it is shown; None where the file does not say.
      alone: it refers to no other frame; None where the library does not say.
      follows_loss: frames between the key frame before it and it, which may refer to them, are not in the stream.
    """

    seconds: float | None
    size: tuple[int, int]
    convert: Callable[[], np.ndarray]
    damaged: bool = False
    lasts: float | None = None
    alone: bool | None = None
    follows_loss: bool = False


class Damage(NamedTuple):
    """A frame that cannot be decoded, in the place where it would be shown; `seconds` as in `Picture`."""

    seconds: float | None
    reason: str


class Complaint(NamedTuple):
    """What the library says of damage on the way to what follows: pictures about it may be wrong in parts, or missing.
    It stands for no frame."""

    text: str


class CodecChange(NamedTuple):
    """What follows is coded otherwise than what came before, and is not decoded; `seconds` as in `Picture`."""

    seconds: float | None
    before: str
    after: str


class PictureStream(Protocol):
    """A video file, camera or network stream, of which every call of `pictures` begins anew."""

    def pictures(self) -> Iterator[Picture | Damage | Complaint | CodecChange]:
        """The frames in the order in which they are shown; nothing follows a change of the codec.

        Raises:
          InputError: it cannot be opened, holds no video, or nothing of it can be decoded.
        """


class VideoDecoder(PictureStream, Protocol):
    """A video file that can be decoded from its beginning, again and again."""

    def header(self) -> VideoHeader:
        """What is known of the video; decodes no more than its first frames.

        Raises:
          InputError: as `pictures` does.
        """
