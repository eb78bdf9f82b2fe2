"""Errors over all pairs of a clip's frames, cheap enough for every training step."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from logvggt_jax.geometry import compose, invert, rotation_angle
from logvggt_jax.training.losses import Mean

MIN_MOTION = 1e-4


def pairwise_pose_errors(predicted: jax.Array, true: jax.Array, frame_valid: jax.Array) -> dict[str, Mean]:
    """Means over pairs of frames, in degrees.

    `rotation` is the error of the relative rotation, `identity_rotation` that of the answer "no motion" (their
    ratio stays at one while the network has learned no rotation), `translation_direction` the angle between the
    relative translations, 90 for a random answer, over pairs that move.

    Args:
      predicted: [B, T, 3|4, 4] world-to-camera.
      true: [B, T, 4, 4] world-to-camera, in units of the clip's mean point distance.
      frame_valid: [B, T] bool.
    """
    frames = true.shape[1]
    pair = frame_valid[:, :, None] & frame_valid[:, None, :] & jnp.tri(frames, k=-1, dtype=bool)
    found, wanted = _relative(predicted), _relative(true)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=true.dtype), wanted[..., :3, :3].shape)
    rotation = rotation_angle(found[..., :3, :3], wanted[..., :3, :3])
    still = rotation_angle(identity, wanted[..., :3, :3])
    a, b = found[..., :3, 3], wanted[..., :3, 3]
    moves = pair & ((b * b).sum(-1) > MIN_MOTION**2)
    cross = jnp.sqrt((jnp.cross(a, b) ** 2).sum(-1))
    direction = jnp.arctan2(cross, (a * b).sum(-1))
    return {
        "rotation": _mean_degrees(rotation, pair),
        "identity_rotation": _mean_degrees(still, pair),
        "translation_direction": _mean_degrees(direction, moves),
    }


def _relative(extrinsics: jax.Array) -> jax.Array:
    return compose(extrinsics[:, :, None], invert(extrinsics)[:, None])


def _mean_degrees(angles: jax.Array, valid: jax.Array) -> Mean:
    return Mean(jnp.rad2deg(jnp.where(valid, angles, 0.0)).sum(), valid.sum().astype(jnp.float32))
