"""The weighted objective over a whole batch, and the figures that are logged beside it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from logvggt_jax.geometry import decode_poses
from logvggt_jax.training import losses, vggt_losses
from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.losses import Mean
from logvggt_jax.training.normalization import Targets
from logvggt_jax.training.pose_errors import pairwise_pose_errors
from logvggt_jax.types import Predictions


def loss_terms(predictions: Predictions, targets: Targets, config: LossConfig) -> dict[str, Mean]:
    """Every term of the objective over the clips at hand; names begin with `camera` or `depth`."""
    dense = (predictions.depth, predictions.depth_confidence, targets.depth, targets.depth_valid)
    if config.name == "log_vggt":
        camera = losses.camera_loss(
            predictions.pose_encodings,
            targets.pose_encoding,
            targets.frame_valid,
            translation_weight=config.translation_weight,
            rotation_weight=config.rotation_weight,
            field_of_view_weight=config.field_of_view_weight,
            gamma=config.gamma,
        )
        return {"camera": camera, **losses.depth_losses(*dense, alpha=config.alpha)}
    return {
        **vggt_losses.camera_losses(
            predictions.pose_encodings,
            targets.pose_encoding,
            targets.frame_valid,
            targets.depth_valid,
            gamma=config.gamma,
        ),
        **vggt_losses.depth_losses(*dense, alpha=config.alpha, quantile=config.quantile),
    }


def term_weights(config: LossConfig) -> dict[str, float]:
    """Weight of each term in the objective (LoG-VGGT: all 1; VGGT's trainer: camera 5, depth 1)."""
    depth = dict.fromkeys(
        ("depth_error", "depth_regression", "depth_gradient", "depth_confidence"), config.depth_weight
    )
    parts = {
        "camera_translation": config.translation_weight,
        "camera_rotation": config.rotation_weight,
        "camera_field_of_view": config.field_of_view_weight,
    }
    camera = {name: config.camera_weight * weight for name, weight in parts.items()}
    return {"camera": config.camera_weight, **camera, **depth}


def total_loss(values: dict[str, jax.Array], config: LossConfig) -> jax.Array:
    """The objective of terms that were averaged already."""
    weights = term_weights(config)
    return sum((weights[name] * value for name, value in values.items()), start=jnp.zeros(()))


def progress_figures(predictions: Predictions, targets: Targets) -> dict[str, Mean]:
    """What tells a plateau from progress: pose errors over pairs, depth errors, mean confidence.

    Depth is compared in the clip's normalised unit, without any alignment.
    """
    size = (predictions.depth.shape[-2], predictions.depth.shape[-1])
    extrinsics, _ = decode_poses(predictions.pose_encoding, size)
    valid, depth = targets.depth_valid, jnp.maximum(predictions.depth, 1e-6)
    target = jnp.where(valid, targets.depth, 1.0)
    count = valid.sum().astype(jnp.float32)

    def over_pixels(values: jax.Array) -> Mean:
        return Mean(jnp.where(valid, values, 0.0).sum(), count)

    return {
        **pairwise_pose_errors(extrinsics, targets.extrinsics, targets.frame_valid),
        "abs_rel": over_pixels(jnp.abs(depth - target) / target),
        "delta_1.25": over_pixels((jnp.maximum(depth / target, target / depth) < 1.25).astype(jnp.float32)),
        "mean_confidence": over_pixels(predictions.depth_confidence),
    }
