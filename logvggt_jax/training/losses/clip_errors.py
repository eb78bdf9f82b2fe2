"""Errors of a batch's clips on the devices, in every training step: by the definitions of `logvggt_jax.metrics`.

The values tell progress from a plateau, and can be compared with validation and evaluation.
"""

import jax
import jax.numpy as jnp

from logvggt_jax.geometry import compose, decode_poses, invert, rotation_angle
from logvggt_jax.training.losses.mean import Mean
from logvggt_jax.training.losses.normalization import Targets
from logvggt_jax.training.losses.order_statistics import order_statistic
from logvggt_jax.types import Predictions

SMALLEST_DEPTH = 1e-5


def clip_errors(predictions: Predictions, targets: Targets) -> dict[str, Mean]:
    """Pose errors over pairs of frames, depth errors over valid pixels, and the mean confidence there."""
    size = (predictions.depth.shape[-2], predictions.depth.shape[-1])
    extrinsics, _ = decode_poses(predictions.pose_encoding, size)
    valid = targets.depth_valid
    confidence = Mean(jnp.where(valid, predictions.depth_confidence, 0.0).sum(), valid.sum().astype(jnp.float32))
    return {
        **pose_errors(extrinsics, targets.extrinsics, targets.frame_valid),
        **depth_errors(predictions.depth, targets.depth, valid),
        "mean_confidence": confidence,
    }


def pose_errors(predicted: jax.Array, true: jax.Array, frame_valid: jax.Array) -> dict[str, Mean]:
    """Means over pairs of frames, in degrees; `relative_pose_errors` of the metrics.

    Cameras are world-to-camera, the predicted ones [B, T, 3|4, 4] in any unit, the true ones [B, T, 4, 4]; frames that
    are not `frame_valid` bool [B, T] form no pairs. `rotation` is the error of the relative rotation,
    `identity_rotation` that of the answer "no motion" (their ratio stays at one while the network has learned no
    rotation), `translation_direction` the angle between the lines of the relative translations: 0 to 90, 57 on average
    for random ones, 90 where one has no length.
    """
    frames = true.shape[1]
    pair = frame_valid[:, :, None] & frame_valid[:, None, :] & ~jnp.tri(frames, dtype=bool)
    found, wanted = _relative(predicted), _relative(true)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=true.dtype), wanted[..., :3, :3].shape)
    a, b = found[..., :3, 3], wanted[..., :3, 3]
    sine, cosine = jnp.sqrt((jnp.cross(a, b) ** 2).sum(-1)), jnp.abs((a * b).sum(-1))
    angles = {
        "rotation": rotation_angle(found[..., :3, :3], wanted[..., :3, :3]),
        "identity_rotation": rotation_angle(identity, wanted[..., :3, :3]),
        "translation_direction": jnp.where((sine > 0) | (cosine > 0), jnp.arctan2(sine, cosine), jnp.pi / 2),
    }
    count = pair.sum().astype(jnp.float32)
    return {name: Mean(jnp.rad2deg(jnp.where(pair, angle, 0.0)).sum(), count) for name, angle in angles.items()}


def depth_errors(depth: jax.Array, target: jax.Array, valid: jax.Array) -> dict[str, Mean]:
    """`abs_rel` and `delta_1.25` over valid pixels after each clip's median alignment; `depth_metrics` of the metrics.

    All are [B, T, H, W]: predicted depth in any unit, the target, positive where `valid` (bool).
    """
    depth, target, valid = (array.reshape(array.shape[0], -1) for array in (depth, target, valid))
    depth = depth * (_lower_median(target, valid) / _lower_median(depth, valid))[:, None]
    target = jnp.where(valid, target, 1.0)
    clamped = jnp.maximum(depth, SMALLEST_DEPTH)
    values = {
        "abs_rel": jnp.abs(depth - target) / target,
        "delta_1.25": jnp.maximum(clamped / target, target / clamped) < 1.25,
    }
    count = valid.sum().astype(jnp.float32)
    return {name: Mean(jnp.where(valid, value, 0.0).sum(), count) for name, value in values.items()}


def _lower_median(values: jax.Array, valid: jax.Array) -> jax.Array:
    """The lower of the two middle values of the valid ones of [B, N]."""
    middle = jnp.maximum(valid.sum(-1) - 1, 0) // 2
    return order_statistic(jnp.where(valid, values, jnp.inf), middle)


def _relative(extrinsics: jax.Array) -> jax.Array:
    """Motion from frame j to frame i of extrinsics [B, T, 3, 4], as [B, i, j, 3, 4]."""
    return compose(extrinsics[:, :, None], invert(extrinsics)[:, None])
