"""The parameters that a run starts from."""

from typing import Any

import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights.checkpoints import from_pretrained
from logvggt_jax.weights.vggt import parameter_shapes


def initial_parameters(config: ModelConfig, *, seed: int, weights: str | None = None) -> Any:
    """Random parameters, or those of `weights` (a path or hub repository that `from_pretrained` reads).

    Raises:
      InputError: the weights do not fit `config`; names the first leaf that differs. What `from_pretrained` raises.
    """
    model = LogVGGT(config)
    if weights is None:
        patch = config.encoder.patch_size
        return model.init(jax.random.key(seed), jnp.zeros((1, 1, patch, patch, 3)))["params"]
    params = from_pretrained(weights, point_head=config.point_head is not None)[1]["params"]
    found, expected = _shapes(params), _shapes(parameter_shapes(config))
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            raise InputError(
                f"initial_weights={weights}: {name} has shape {found.get(name, 'none')}, config.model asks for "
                f"{expected.get(name, 'none')}; give config.model the sizes of the checkpoint"
            )
    return params


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): tuple(leaf.shape) for path, leaf in leaves}
