"""The paper's training objective, each term a `Mean` over what is valid, by clips."""

import jax
import jax.numpy as jnp

from logvggt_jax.training.losses.mean import Mean

# Axes of a clip's pixels: frames, rows, columns.
PIXELS = (1, 2, 3)


def camera_loss(
    pose_encodings: jax.Array,
    target: jax.Array,
    frame_valid: jax.Array,
    *,
    translation_weight: float,
    rotation_weight: float,
    field_of_view_weight: float,
    gamma: float,
) -> Mean:
    """L_camera, the mean over frames of (1/S) sum_s gamma^(S-s) |g_s - g|_1.

    The S rounds of the camera head [B, T, S, 9] are compared with the target [B, T, 9] where `frame_valid` bool [B, T].
    The distance is the weighted sum of the l1 norms of translation, quaternion and fields of view. Source: LoG-VGGT,
    "Training Objective", second and third equation; the mean over frames instead of their sum makes clips of different
    lengths weigh alike.
    """
    rounds = pose_encodings.shape[-2]
    weights = jnp.asarray([translation_weight] * 3 + [rotation_weight] * 4 + [field_of_view_weight] * 2, jnp.float32)
    decay = jnp.asarray([gamma ** (rounds - 1 - s) / rounds for s in range(rounds)], jnp.float32)
    distance = (jnp.abs(pose_encodings - target[..., None, :]) * weights).sum(-1)
    per_frame = (distance * decay).sum(-1)
    return Mean(jnp.where(frame_valid, per_frame, 0.0).sum(-1), frame_valid.sum(-1).astype(jnp.float32))


def depth_losses(
    depth: jax.Array, confidence: jax.Array, target: jax.Array, valid: jax.Array, *, alpha: float
) -> dict[str, Mean]:
    """The three terms of L_depth, each a mean over the pixels where `valid` bool [B, T, H, W].

    `depth_error` is S |D' - D|, `depth_gradient` S (|dx(D' - D)| + |dy(D' - D)|) with forward differences where both
    pixels are valid, `depth_confidence` -alpha log S, of depth D', its confidence S (at least 1) and the target D
    (finite everywhere), all [B, T, H, W]. Source: LoG-VGGT, "Training Objective", fourth equation, as means, with
    absolute values for the norm over one channel.
    """
    weight = jnp.where(valid, confidence, 1.0)
    count = valid.sum(PIXELS).astype(jnp.float32)
    error, gradient = weighted_errors(depth, target, valid, weight)
    return {
        "depth_error": Mean(error, count),
        "depth_gradient": Mean(gradient, count),
        "depth_confidence": Mean(-alpha * jnp.log(weight).sum(PIXELS), count),
    }


def weighted_errors(
    depth: jax.Array, target: jax.Array, valid: jax.Array, weight: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """[B]: sums over valid pixels of weighted absolute errors, and of their differences between neighbours."""
    error = jnp.where(valid, depth - target, 0.0)
    both_x = valid[..., :, 1:] & valid[..., :, :-1]
    both_y = valid[..., 1:, :] & valid[..., :-1, :]
    along_x = weight[..., :, :-1] * jnp.abs(error[..., :, 1:] - error[..., :, :-1])
    along_y = weight[..., :-1, :] * jnp.abs(error[..., 1:, :] - error[..., :-1, :])
    gradient = jnp.where(both_x, along_x, 0.0).sum(PIXELS) + jnp.where(both_y, along_y, 0.0).sum(PIXELS)
    return (weight * jnp.abs(error)).sum(PIXELS), gradient
