"""Parameters of the parts, {"params": {part: …}}: the parts as functions of their own, and other forms of the same.

Files and `LogVGGT.init` hold float32 parameters, layer by layer. Streams want the large ones in the compute type;
training wants the layers of deep stacks stacked, so that one loop body is compiled for all of them.
"""

from __future__ import annotations

import re
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig

Variables = dict[str, Any]

_LAYER = re.compile(r"(.*_)?block_(\d+)")
# The camera head computes in float32 whatever the compute type.
_COMPUTE_TYPE_PARTS = ("encoder", "aggregator", "depth_head", "point_head", "gccr")


def run(module: nn.Module, params: Any, *inputs: Any, **options: Any) -> Any:
    """A linen module as a pure function of its own parameters."""
    return module.apply({"params": params}, *inputs, **options)


def stacked(variables: Variables) -> Variables:
    """The layers of encoder and aggregator as one: `frame_block_0` … `frame_block_23` become `frame_blocks` with a
    leading axis of layers, likewise `global_blocks` and the encoder's `blocks`."""
    params = dict(variables["params"])
    for part in ("encoder", "aggregator"):
        others: dict[str, Any] = {}
        families: dict[str, dict[int, Any]] = {}
        for name, tree in params[part].items():
            if match := _LAYER.fullmatch(name):
                families.setdefault(f"{match[1] or ''}blocks", {})[int(match[2])] = tree
            else:
                others[name] = tree
        for name, layers in families.items():
            others[name] = jax.tree.map(lambda *x: jnp.stack(x), *[layers[i] for i in range(len(layers))])
        params[part] = others
    return {**variables, "params": params}


def in_compute_type(variables: Variables, config: ModelConfig) -> Variables:
    """The kernels and biases of products in the compute type, as the products would round them at every call."""

    def cast(tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        if "kernel" in tree:
            return {name: x.astype(config.dtype) for name, x in tree.items()}
        return {name: cast(inner) for name, inner in tree.items()}

    params = variables["params"]
    return {"params": {part: cast(tree) if part in _COMPUTE_TYPE_PARTS else tree for part, tree in params.items()}}
