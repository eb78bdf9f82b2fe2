"""Parameters of the parts, {"params": {part: …}}: the parts as functions of their own, and other forms of the same.

Files and `LogVGGT.init` hold float32 parameters, layer by layer. Streams want the large ones in the compute type;
training wants the layers of deep stacks stacked, so that one loop body is compiled for all of them, and may hold a part
of each on every device.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Container
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from logvggt_jax.config import ModelConfig

Variables = dict[str, Any]

_LAYER = re.compile(r"(.*block|trunk)_(\d+)")
_STACK = re.compile(r"(.*_)?blocks|trunk")
# The camera head computes in float32 whatever the compute type.
_COMPUTE_TYPE_PARTS = ("encoder", "aggregator", "depth_head", "point_head", "gccr")


@struct.dataclass
class Part:
    """One device's part of a parameter; a pytree node in the parameter's place, for use within `shard_map`.

    Attributes:
      value: the part.
      axis: of the parameter, that is split; counted from the end, so that a layer of a stack is split as the stack is.
      mesh_axis: over which it is split.
    """

    value: jax.Array
    axis: int = struct.field(pytree_node=False)
    mesh_axis: str = struct.field(pytree_node=False)

    def whole(self) -> jax.Array:
        """The parameter; its gradient goes back to the devices as the sum's parts."""
        return jax.lax.all_gather(self.value, self.mesh_axis, axis=self.value.ndim + self.axis, tiled=True)


@functools.partial(jax.jit, static_argnums=0, static_argnames=("grid", "image_size", "method"))
def run(module: nn.Module, params: Any, *inputs: Any, **options: Any) -> Any:
    """A linen module as a pure function of its own parameters, traced once for all inputs of one form.

    A deep stack is so traced and lowered as one layer that is called many times; the compiler puts it back in all its
    places. Parameters that come in parts are put together here, where they are used; stacks stay in parts for the loop
    over them, whose body runs one layer with this function.
    """
    return module.apply({"params": whole(params)}, *inputs, **options)


def given(module: nn.Module, name: str) -> bool:
    """Whether the parameters of a module's part are there to `run` it; False too where its intermediates are asked for
    (`capture_intermediates`), which parts give that the module calls itself."""
    return module.has_variable("params", name) and not module.is_mutable_collection("intermediates")


def whole(params: Any) -> Any:
    """Parameters with every `Part` put together, but for those of stacks."""

    def put_together(path: Any, leaf: Any) -> Any:
        stacked = any(is_stack(entry.key) for entry in path)
        return leaf.whole() if isinstance(leaf, Part) and not stacked else leaf

    return jax.tree_util.tree_map_with_path(put_together, params, is_leaf=lambda node: isinstance(node, Part))


def stack_layers(tree: Any) -> Any:
    """A tree of parameters (or of an optimiser's moments) with the layers of deep stacks as one.

    `frame_block_0` … `frame_block_23` become `frame_blocks` with a leading axis of layers; likewise `global_blocks`,
    the encoder's `blocks` and the camera head's `trunk`. What is stacked already stays. Arrays of numpy stay
    numpy's.
    """

    def stacked(*layers: Any) -> Any:
        return np.stack(layers) if all(isinstance(layer, np.ndarray) for layer in layers) else jnp.stack(layers)

    def stack(node: Any) -> Any:
        if not _has_layers(node):
            return node
        families: dict[str, dict[int, Any]] = {}
        others: dict[str, Any] = {}
        for name, inner in node.items():
            if match := _LAYER.fullmatch(name):
                families.setdefault(match[1].replace("block", "blocks"), {})[int(match[2])] = inner
            else:
                others[name] = inner
        for name, layers in families.items():
            others[name] = jax.tree.map(stacked, *[layers[i] for i in range(len(layers))])
        return others

    return jax.tree.map(stack, tree, is_leaf=_has_layers)


def unstack_layers(
    tree: Any,
    config: ModelConfig,
    take: Callable[[Any, int], Any] = lambda x, layer: x[layer],
    *,
    kept: Container[str] = (),
) -> Any:
    """Inverse of `stack_layers` for a model of these sizes; `take` makes one layer's leaf of a stacked one.

    Stacks without leaves, which an optimiser's state has for what is frozen, come apart as well; those of the names
    `kept` stay as they are.
    """
    depths = {"blocks": config.encoder.depth, "trunk": config.camera_head.depth}

    def unstack(node: Any) -> Any:
        if not _is_stacked(node):
            return node
        layers: dict[str, Any] = {}
        for name, inner in node.items():
            if name in kept or not is_stack(name):
                layers[name] = inner
                continue
            for layer in range(depths.get(name, config.aggregator.depth)):
                layers[f"{name.removesuffix('s')}_{layer}"] = jax.tree.map(lambda x, i=layer: take(x, i), inner)
        return layers

    return jax.tree.map(unstack, tree, is_leaf=_is_stacked)


def is_stack(name: str) -> bool:
    """Whether leaves under this name in a tree of parameters have a leading axis of layers."""
    return _STACK.fullmatch(name) is not None


def _has_layers(node: Any) -> bool:
    return isinstance(node, dict) and any(_LAYER.fullmatch(name) for name in node)


def _is_stacked(node: Any) -> bool:
    return isinstance(node, dict) and any(map(is_stack, node))


def in_compute_type(variables: Variables, config: ModelConfig) -> Variables:
    """Parameters as streams want them, layer by layer or stacked: kernels and biases of products in the compute type,
    as the products would round them at every call, and in every block `query` and `key_value` side by side as one
    product, `query_key_value`, as a compiler would put them at every call. What has this form stays as it is.
    """

    def cast(tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        if "kernel" in tree:
            return {name: x.astype(jnp.dtype(config.dtype)) for name, x in tree.items()}
        return side_by_side({name: cast(inner) for name, inner in tree.items()})

    def side_by_side(tree: dict[str, Any]) -> dict[str, Any]:
        """Of kernels in eight bits the tokens' codes would be shared as well; they stay apart."""
        query, key_value = tree.get("query"), tree.get("key_value")
        if query is None or key_value is None or "kernel" not in query:
            return tree
        both = {name: jnp.concatenate([query[name], key_value[name]], axis=-1) for name in query}
        return {name: x for name, x in tree.items() if name not in ("query", "key_value")} | {"query_key_value": both}

    params = variables["params"]
    return {"params": {part: cast(tree) if part in _COMPUTE_TYPE_PARTS else tree for part, tree in params.items()}}
