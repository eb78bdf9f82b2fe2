"""The parameters that a run starts from."""

from typing import Any

import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights.checkpoints import first_misfit, from_pretrained
from logvggt_jax.weights.vggt import parameter_shapes


def initial_parameters(config: ModelConfig, *, seed: int, weights: str | None = None) -> Any:
    """Random parameters, or those of `weights` (a path or hub repository that `from_pretrained` reads).

    Raises what that does, and InputError naming the first leaf in which they do not fit `config`.
    """
    model = LogVGGT(config)
    if weights is None:
        patch = config.encoder.patch_size
        return model.init(jax.random.key(seed), jnp.zeros((1, 1, patch, patch, 3)))["params"]
    params = from_pretrained(weights, point_head=config.point_head is not None)[1]["params"]
    if wrong := first_misfit(params, parameter_shapes(config), "config.model"):
        raise InputError(f"initial_weights={weights}: {wrong}; give config.model the sizes of the checkpoint")
    return params
