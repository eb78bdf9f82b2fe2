"""What whoever watches a run is shown while it goes on."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from logvggt_jax.streaming import FrameResult


class LiveResult(NamedTuple):
    """A frame whose depth is final.

    Attributes:
      name: of the frame; of a live session `frame-000123` with its position among all frames that came.
      timestamp: of a live session as it was pushed, seconds.
      image: [h, w, 3] uint8, the frame at the model's size.
      original_size: (H, W) of the frame before.
      result: depth, confidence and pose; `result.index` is its position among the frames that were used.
    """

    name: str
    timestamp: float
    image: np.ndarray
    original_size: tuple[int, int]
    result: FrameResult


class Watcher(Protocol):
    """Looks on while frames become final. The run calls it in its own thread and waits for it."""

    def add(self, frame: LiveResult) -> object:
        """The next frame; its pose may come later, or change."""
        ...

    def place(self, pose_encodings: np.ndarray) -> object:
        """Pose encodings [N, 9] of the first N frames, as they are known by now."""
        ...
