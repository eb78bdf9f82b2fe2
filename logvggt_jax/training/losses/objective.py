"""The weighted objective over a whole batch."""

import jax
import jax.numpy as jnp

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.losses import log_vggt, vggt
from logvggt_jax.training.losses.distillation import distilled_depth_losses
from logvggt_jax.training.losses.mean import Mean
from logvggt_jax.training.losses.normalization import Targets
from logvggt_jax.types import Predictions


def loss_terms(
    predictions: Predictions, targets: Targets, config: LossConfig, confidence: jax.Array | None = None
) -> dict[str, Mean]:
    """Every term of the objective over the clips at hand; names begin with `camera` or `depth`.

    A distillation needs the `confidence` [B, T, H, W] of the teacher whose targets these are: InputError without it.
    """
    dense = (predictions.depth, predictions.depth_confidence, targets.depth, targets.depth_valid)
    if config.name in ("log_vggt", "distillation"):
        camera = log_vggt.camera_loss(
            predictions.pose_encodings,
            targets.pose_encoding,
            targets.frame_valid,
            translation_weight=config.translation_weight,
            rotation_weight=config.rotation_weight,
            field_of_view_weight=config.field_of_view_weight,
            gamma=config.gamma,
        )
        if config.name == "log_vggt":
            return {"camera": camera, **log_vggt.depth_losses(*dense, alpha=config.alpha)}
        if confidence is None:
            raise InputError("loss.name='distillation' learns from a teacher's confidence, which these clips lack")
        return {"camera": camera, **distilled_depth_losses(*dense, confidence, alpha=config.alpha)}
    return {
        **vggt.camera_losses(
            predictions.pose_encodings,
            targets.pose_encoding,
            targets.frame_valid,
            targets.depth_valid,
            gamma=config.gamma,
        ),
        **vggt.depth_losses(*dense, alpha=config.alpha, quantile=config.quantile),
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
