"""The parameters that a run starts from."""

import contextlib
from typing import Any

import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import first_misfit, from_pretrained, read_config
from logvggt_jax.weights.vggt import parameter_shapes


def initial_parameters(config: ModelConfig, *, seed: int, weights: str | None = None) -> Any:
    """Random parameters, or those of `weights` (a path or hub repository that `from_pretrained` reads); deep stacks as
    one, see `stack_layers`.

    They are numpy arrays. Random ones are drawn on the host where JAX has it as a device; where it was told to use the
    accelerators alone the first of them draws, and keeps nothing. Weights are read and stacked without any device.
    Raises what `from_pretrained` does, and InputError naming the first leaf in which they do not fit `config`.
    """
    if weights is not None:
        params = from_pretrained(weights, point_head=config.point_head is not None, on_host=True)[1]["params"]
        _check_fit(params, config, weights)
        return stack_layers(params)
    with _on_host():
        patch = config.encoder.patch_size
        model, images = LogVGGT(config), jnp.zeros((1, 1, patch, patch, 3))
        return stack_layers(jax.device_get(model.init(jax.random.key(seed), images)["params"]))


def check_weights(config: ModelConfig, weights: str) -> None:
    """Raises InputError where `initial_parameters` would for `weights`, as far as is seen without reading a parameter;
    those of a hub are downloaded."""
    found = read_config(resolve(weights), point_head=config.point_head is not None)
    _check_fit(parameter_shapes(found), config, weights)


def _check_fit(params: Any, config: ModelConfig, weights: str) -> None:
    if wrong := first_misfit(params, parameter_shapes(config), "config.model"):
        raise InputError(f"initial_weights={weights}: {wrong}; give config.model the sizes of the checkpoint")


def _on_host() -> contextlib.AbstractContextManager[Any]:
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX was told to use the accelerators alone.
        return contextlib.nullcontext()
