"""Overlapping windows: index arithmetic and the state that one window hands to the next."""

from __future__ import annotations

import jax
from flax import struct


@struct.dataclass
class WindowState:
    """All that a stream carries from window to window; its size does not depend on the sequence.

    F = K − s frames overlap. They are the last F of the window before and the first F of the window to come.

    Attributes:
      patch_tokens: [B, F, h * w, C] float32, the overlap frames as the encoder left them.
      key_tokens: [B, key layers, F, P, 2C] compute dtype, their key-layer outputs in the last window: the depth
        head's input when they become final, and, one half of the channels, the cache of cross-window attention.
      special_tokens: [B, F, 5, 2C] float32, their camera and register tokens in the last window.
      frame_mask: bool [B, F], False for padding.
      step: int32 [B], windows done.
      image_size: (H, W), static.
    """

    patch_tokens: jax.Array
    key_tokens: jax.Array
    special_tokens: jax.Array
    frame_mask: jax.Array
    step: jax.Array
    image_size: tuple[int, int] = struct.field(pytree_node=False)


def num_windows(num_frames: int, size: int, stride: int) -> int:
    """Windows that cover `num_frames` frames; window i holds frames i·stride … i·stride + size − 1."""
    return 1 if num_frames <= size else -(-(num_frames - size) // stride) + 1


def kept_window(frame: int, num_frames: int, size: int, stride: int) -> int:
    """The window whose copy of `frame` counts: the last one that holds it."""
    return min(frame // stride, num_windows(num_frames, size, stride) - 1)


def first_window(frame: int, size: int, stride: int) -> int:
    """The first window that holds `frame`."""
    return max(0, -(-(frame - size + 1) // stride))
