"""Which frames' registers GCCR keeps when their number is bounded."""

from __future__ import annotations

from typing import TypeVar

import jax
import numpy as np

# numpy on the host, where a stream gives room to new frames, and JAX in the model.
Array = TypeVar("Array", np.ndarray, jax.Array)

_LEVELS = np.arange(31, dtype=np.int32)


def is_kept(frame: Array, count: Array, max_frames: int) -> Array:
    """Whether GCCR reads a frame's registers once `count` frames are there.

    Of more than `max_frames`, M, it keeps the first, the newest M // 2, and between them the multiples of the smallest
    power of two that leaves no more than fit. What is left out once is never asked for again, so that a stream can
    forget it.

    Args:
      frame: int, any shape.
      count: int, a shape that broadcasts with it.
      max_frames: at least 2.

    Returns:
      bool, False at and beyond `count`.
    """
    newest = max_frames // 2
    between = max_frames - 1 - newest
    older = (count - newest - 1).clip(0)
    level = ((older[..., None] >> _LEVELS) <= between).argmax(-1)
    spaced = (frame >> level) << level == frame
    return (frame < count) & ((count <= max_frames) | (frame >= count - newest) | spaced)
