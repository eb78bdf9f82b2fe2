"""The depth loss of a student, whose targets and weights are its teacher's; its camera loss is the paper's."""

import jax
import jax.numpy as jnp

from logvggt_jax.training.losses.log_vggt import PIXELS, weighted_errors
from logvggt_jax.training.losses.mean import Mean


def distilled_depth_losses(
    depth: jax.Array,
    confidence: jax.Array,
    target: jax.Array,
    valid: jax.Array,
    target_confidence: jax.Array,
    *,
    alpha: float,
) -> dict[str, Mean]:
    """Distances to a teacher's depth and confidence, each a mean over the pixels where `valid` bool [B, T, H, W].

    `depth_error` and `depth_gradient` are those of `depth_losses` with another weight: the teacher's confidence over
    its mean in the clip, so that what it is unsure of counts less, and clips weigh alike. `depth_confidence` is
    alpha |log S - log S_teacher| of the student's confidence S. All arrays are [B, T, H, W], float32.
    """
    count = valid.sum(PIXELS).astype(jnp.float32)
    known = jnp.where(valid, target_confidence, 0.0)
    mean = known.sum(PIXELS) / jnp.maximum(count, 1.0)
    weight = known / jnp.maximum(mean, 1.0)[:, None, None, None]
    error, gradient = weighted_errors(depth, target, valid, weight)
    distance = jnp.log(jnp.where(valid, confidence, 1.0)) - jnp.log(jnp.where(valid, target_confidence, 1.0))
    return {
        "depth_error": Mean(error, count),
        "depth_gradient": Mean(gradient, count),
        "depth_confidence": Mean(alpha * jnp.abs(distance).sum(PIXELS), count),
    }
