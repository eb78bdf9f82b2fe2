"""One normalisation a clip: the first camera is the origin, the mean distance of the points is one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from logvggt_jax.geometry import encode_poses, relative_to_first, unproject

MIN_DEPTH = 1e-8
MIN_SCALE, MAX_SCALE = 1e-6, 1e6


class Targets(NamedTuple):
    """Ground truth of a batch of clips in the units that the network is to predict."""

    pose_encoding: jax.Array  # [B, T, 9] float32, encoding of `extrinsics` and the intrinsics
    # [B, T, 4, 4] float32, world-to-camera, the world being the clip's first camera; lengths in units of `scale`.
    # Identity where `frame_valid` is False.
    extrinsics: jax.Array
    depth: jax.Array  # [B, T, H, W] float32 z-depth in units of `scale`, 0 where invalid
    depth_valid: jax.Array  # [B, T, H, W] bool
    frame_valid: jax.Array  # [B, T] bool: a frame of the clip (not padding) with a known camera
    scale: jax.Array  # [B] float32, mean distance of the clip's points from its first camera, in the input's unit


def normalize_clips(
    depth: jax.Array, intrinsics: jax.Array, extrinsics: jax.Array, *, frame_mask: jax.Array | None = None
) -> Targets:
    """Expresses clips relative to their first camera, divided by the mean point distance.

    Float32: z-depth [B, T, H, W], 0 or non-finite where invalid, intrinsics [B, T, 3, 3] in pixels, extrinsics [B, T,
    3|4, 4] world-to-camera (OpenCV); `frame_mask` bool [B, T] is False on padding, None if all frames are real. Only
    ground truth is rescaled; predictions are compared as they are. Frames without a finite camera count as absent, and
    so does a whole clip whose first camera is unknown or that has no valid depth: neither gives a scale. Source: VGGT's
    released trainer (scene normalisation), per clip as in DUSt3R.
    """
    known = jnp.isfinite(extrinsics).all((-2, -1)) & jnp.isfinite(intrinsics).all((-2, -1))
    if frame_mask is not None:
        known &= frame_mask
    known &= known[:, :1]
    identity = jnp.eye(4, dtype=depth.dtype)
    cameras = jnp.where(known[..., None, None], extrinsics, identity[: extrinsics.shape[-2]])
    intrinsics = jnp.where(known[..., None, None], intrinsics, identity[:3, :3])
    relative = relative_to_first(cameras)

    valid = jnp.isfinite(depth) & (depth > MIN_DEPTH) & known[..., None, None]
    depth = jnp.where(valid, depth, 0.0)
    points = unproject(depth, intrinsics, relative)
    distance = jnp.where(valid, jnp.sqrt((points * points).sum(-1)), 0.0)
    count = valid.sum((1, 2, 3))
    scale = jnp.clip(distance.sum((1, 2, 3)) / (count + 1e-3), MIN_SCALE, MAX_SCALE)

    frame_valid = known & (count > 0)[:, None]
    scale = jnp.where(count > 0, scale, 1.0)
    translation = relative[..., :3, 3:] / scale[:, None, None, None]
    rigid = jnp.concatenate([relative[..., :3, :3], translation], axis=-1)
    last = jnp.broadcast_to(relative[..., 3:, :], (*relative.shape[:-2], 1, 4))
    relative = jnp.concatenate([rigid, last], axis=-2)
    relative = jnp.where(frame_valid[..., None, None], relative, identity)
    return Targets(
        pose_encoding=encode_poses(relative, intrinsics, (depth.shape[-2], depth.shape[-1])),
        extrinsics=relative,
        depth=depth / scale[:, None, None, None],
        depth_valid=valid,
        frame_valid=frame_valid,
        scale=scale,
    )
