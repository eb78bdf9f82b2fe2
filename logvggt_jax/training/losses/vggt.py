"""The losses of VGGT's released trainer, an alternative to the paper's objective.

They average over whatever one device holds (the depth terms drop that batch's largest 2 %), so their values are
averaged over devices as they are, which is what the trainer's data parallelism does.
"""

import jax
import jax.numpy as jnp

from logvggt_jax.training.losses.mean import Mean
from logvggt_jax.training.losses.order_statistics import order_statistic

LIMIT = 100.0
MIN_PIXELS = 100
MIN_FILTERED = 1000
GRADIENT_SCALES = (1, 2, 4, 8)


def camera_losses(
    pose_encodings: jax.Array,
    target: jax.Array,
    frame_valid: jax.Array,
    depth_valid: jax.Array,
    *,
    gamma: float,
) -> dict[str, Mean]:
    """Translation, rotation and field-of-view terms, each (1/S) sum_s gamma^(S-s) of a mean absolute difference.

    The rounds [B, T, S, 9] are compared with the target [B, T, 9] where `frame_valid` bool [B, T], in clips whose first
    frame has more than 100 pixels that are `depth_valid` bool [B, T, H, W].
    """
    rounds = pose_encodings.shape[-2]
    decay = jnp.asarray([gamma ** (rounds - 1 - s) / rounds for s in range(rounds)], jnp.float32)
    counted = frame_valid & (depth_valid[:, 0].sum((-2, -1)) > MIN_PIXELS)[:, None]
    difference = jnp.where(counted[..., None, None], pose_encodings - target[..., None, :], 0.0)
    parts = {"translation": slice(0, 3), "rotation": slice(3, 7), "field_of_view": slice(7, 9)}
    losses = {}
    for name, part in parts.items():
        distance = jnp.abs(difference[..., part])
        if name == "translation":
            distance = jnp.minimum(distance, LIMIT)
        clips = (distance.mean(-1) * decay).sum((1, 2))
        losses[f"camera_{name}"] = _shard_value(clips / jnp.maximum(counted.sum(), 1))
    return losses


def depth_losses(
    depth: jax.Array,
    confidence: jax.Array,
    target: jax.Array,
    valid: jax.Array,
    *,
    alpha: float,
    quantile: float | None = 0.98,
) -> dict[str, Mean]:
    """Confidence, regression and multi-scale gradient terms of the depth loss; 0 below 100 valid pixels.

    Predicted depth, its confidence (at least 1), target and `valid` (bool) are [B, T, H, W]. `quantile` drops the
    largest errors of the first two terms (None: keeps all).
    """
    target = _bounded(target)
    enough = valid.sum() >= MIN_PIXELS
    error = jnp.where(valid, _bounded(jnp.abs(depth - target)), 0.0)
    weight = jnp.where(valid, confidence, 1.0)
    confident = _bounded(error * weight - alpha * jnp.log(weight))
    values = {
        "depth_confidence": _mean_below_quantile(confident, valid, quantile),
        "depth_regression": _mean_below_quantile(error, valid, quantile),
        "depth_gradient": _gradient_loss(depth - target, valid),
    }
    return {name: _shard_value(jnp.where(enough, value, 0.0)) for name, value in values.items()}


def quantile_rank(count: jax.Array, quantile: float) -> jax.Array:
    """int32 scalar: the place, from 0, of a `quantile` in whole hundredths among `count` values, rounded half to even.

    In integers, of any number of pixels: float32 cannot hold the ranks of a large batch, int32 not a hundred of them.
    """
    hundredths, last = round(quantile * 100), jnp.maximum(count, 1) - 1
    rank = hundredths * (last // 100) + hundredths * (last % 100) // 100
    rest = hundredths * (last % 100) % 100
    return rank + ((rest > 50) | ((rest == 50) & (rank % 2 == 1)))


def _bounded(values: jax.Array) -> jax.Array:
    """Values of any shape within ±`LIMIT`, 0 where they are not finite."""
    return jnp.clip(jnp.where(jnp.isfinite(values), values, 0.0), -LIMIT, LIMIT)


def _shard_value(value: jax.Array) -> Mean:
    """A value of one device, or the clips' shares of it [B], as a term that is averaged over devices."""
    return Mean(value, jnp.ones((), value.dtype))


def _mean_below_quantile(values: jax.Array, valid: jax.Array, quantile: float | None) -> jax.Array:
    """Scalar mean of the valid of `values` [B, T, H, W] below their quantile, as the released trainer filters."""
    values, valid = values.reshape(-1), valid.reshape(-1)
    count = valid.sum()
    if quantile is None:
        return jnp.where(valid, values, 0.0).sum() / jnp.maximum(count, 1)
    limited = jnp.minimum(values, LIMIT)
    ranked = jnp.where(valid, jax.lax.stop_gradient(limited), jnp.inf)
    threshold = jnp.minimum(order_statistic(ranked[None], quantile_rank(count, quantile)[None])[0], LIMIT)
    kept = valid & (limited < threshold)
    kept = jnp.where(kept.sum() > MIN_FILTERED, kept, valid)
    long = count > MIN_FILTERED
    chosen = jnp.where(long, kept, valid)
    terms = jnp.where(long, limited, values)
    return jnp.where(chosen, terms, 0.0).sum() / jnp.maximum(chosen.sum(), 1)


def _gradient_loss(error: jax.Array, valid: jax.Array) -> jax.Array:
    """Scalar: differences between neighbouring pixels of `error` [B, T, H, W], averaged over scales."""
    total = jnp.zeros_like(error[0, 0, 0, 0])
    for stride in GRADIENT_SCALES:
        d, m = (array[..., ::stride, ::stride] for array in (error, valid))
        d = jnp.where(m, d, 0.0)
        along_x = jnp.minimum(jnp.abs(d[..., :, 1:] - d[..., :, :-1]), LIMIT)
        along_y = jnp.minimum(jnp.abs(d[..., 1:, :] - d[..., :-1, :]), LIMIT)
        along_x = jnp.where(m[..., :, 1:] & m[..., :, :-1], along_x, 0.0)
        along_y = jnp.where(m[..., 1:, :] & m[..., :-1, :], along_y, 0.0)
        total += (along_x.sum() + along_y.sum()) / jnp.maximum(m.sum(), 1)
    return total / len(GRADIENT_SCALES)
