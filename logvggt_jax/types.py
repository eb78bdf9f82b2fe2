"""Values that cross package borders, as frozen pytrees.

Shape letters, used in every signature: B sequences, T frames, K window size, s window stride, n frames of
one call, H W pixels, P tokens a frame (1 camera, 4 registers, patches), C channels, R rounds of the camera
head, N camera tokens, M frames with register tokens.

Frames of reference are OpenCV's throughout: x right, y down, z forward, pixel centres at integers.
"""

import jax
from flax import struct

from logvggt_jax.frames import Frames

__all__ = ["Frames", "Predictions", "WindowOutput"]


@struct.dataclass
class Predictions:
    """What `LogVGGT.apply` returns; every leaf starts with B, frames are in input order.

    Cameras live in the frame of the sequence's first camera, up to scale; depth is in the same unit. Where a mask drops
    a pixel, depth, points and confidences are 0.

    Attributes:
      pose_encoding: [B, T, 9] float32, the last round of `pose_encodings`.
      pose_encodings: [B, T, R, 9] float32: translation (3), quaternion x y z w (4), vertical and horizontal
        field of view in radians (2).
      extrinsics: [B, T, 3, 4] float32, world-to-camera.
      intrinsics: [B, T, 3, 3] float32, pixels of the input image, principal point (W/2, H/2).
      depth: [B, T, H, W] float32, z-depth.
      depth_confidence: [B, T, H, W] float32, at least 1.
      camera_tokens: [B, T, 2C] float32, before GCCR.
      register_tokens: [B, T, 4, 2C] float32.
      points: [B, T, H, W, 3] float32 in the first camera's frame; None without point head.
      points_confidence: [B, T, H, W] float32; None without point head.
    """

    pose_encoding: jax.Array
    pose_encodings: jax.Array
    extrinsics: jax.Array
    intrinsics: jax.Array
    depth: jax.Array
    depth_confidence: jax.Array
    camera_tokens: jax.Array
    register_tokens: jax.Array
    points: jax.Array | None = None
    points_confidence: jax.Array | None = None


@struct.dataclass
class WindowOutput:
    """Frames that became final in a call of `step` or `finish`, oldest first; 0 where a mask drops a pixel.

    Attributes:
      depth: [B, n, H, W] float32, z-depth.
      depth_confidence: [B, n, H, W] float32, at least 1.
      camera_tokens: [B, n, 2C] float32, before GCCR.
      register_tokens: [B, n, 4, 2C] float32.
      frame_mask: [B, n] bool, False where the entry is padding.
      points: [B, n, H, W, 3] float32; None without point head.
      points_confidence: [B, n, H, W] float32; None without point head.
    """

    depth: jax.Array
    depth_confidence: jax.Array
    camera_tokens: jax.Array
    register_tokens: jax.Array
    frame_mask: jax.Array
    points: jax.Array | None = None
    points_confidence: jax.Array | None = None
