"""A model's parameters before it has any: random ones, and the shapes of all."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Container, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig, RefinementConfig, WindowConfig
from logvggt_jax.model.cross_window import CrossWindowMemory
from logvggt_jax.model.parameters import Variables, unstack_layers
from logvggt_jax.model.refinement import Refinement
from logvggt_jax.model.windows import Windows

# Names of layers after the first.
_LATER = r"block_[1-9]\d*$"


def initial_variables(
    config: ModelConfig, key: jax.Array, image_size: tuple[int, int], *, only: Container[str] | None = None
) -> Variables:
    """{"params": …}, float32, drawn as `LogVGGT.init` says, for images of `image_size` (H, W)."""
    calls = _module_calls(config, image_size)
    keys = jax.random.split(key, 6)
    return {
        "params": {
            name: _drawn(call, key)
            for key, (name, call) in zip(keys, calls.items(), strict=False)
            if only is None or name in only
        }
    }


def shallow(config: ModelConfig) -> ModelConfig:
    """The model with as few layers as there can be, which is traced in a fraction of the time. Layers of a stack are
    alike, and all other parameters have the same shapes and are drawn the same by `initial_variables`."""
    levels = tuple(range(len(config.aggregator.key_layers)))
    encoder = dataclasses.replace(config.encoder, depth=1)
    aggregator = dataclasses.replace(config.aggregator, depth=len(levels), key_layers=levels)
    return dataclasses.replace(config, encoder=encoder, aggregator=aggregator)


def variable_shapes(config: ModelConfig) -> Variables:
    """{"params": …} of a model as `jax.ShapeDtypeStruct`s; nothing is allocated.

    Traced once for all configurations that differ only in depth, and in what shapes do not depend on: windows,
    refinement's mode, rounds of the camera head, compute type, form of attention (and tracing cuDNN's asks for a GPU).
    """
    plain = dataclasses.replace(
        shallow(config),
        camera_head=dataclasses.replace(config.camera_head, iterations=1),
        windows=WindowConfig(),
        refinement=RefinementConfig(num_heads=config.refinement.num_heads),
        dtype="float32",
        attention="xla",
    )
    return unstack_layers({"params": _one_of_each_layer(plain)}, config, take=lambda layer, _: layer)


class _ModuleCall(NamedTuple):
    """A module with what it is called with: abstract arrays, and what is static."""

    module: nn.Module
    inputs: tuple[Any, ...]
    static: Mapping[str, Any] = MappingProxyType({})


def _module_calls(config: ModelConfig, image_size: tuple[int, int]) -> dict[str, _ModuleCall]:
    """Each module by the name of its parameters, with abstract inputs for one frame of `image_size` (H, W)."""
    windows, refinement = Windows(config), Refinement(config)
    grid = windows.grid(image_size)
    width, patches, registers = config.encoder.embed_dim, grid[0] * grid[1], config.aggregator.num_registers

    def floats(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    lengths, first = jax.ShapeDtypeStruct((1,), jnp.int32), jax.ShapeDtypeStruct((1,), bool)
    cached = floats(1, len(config.aggregator.key_layers), 1, config.aggregator.num_special + patches, width)
    memory = CrossWindowMemory(cached, lengths, config.aggregator.key_layers)  # type: ignore[arg-type]
    camera, levels = floats(1, 1, 2 * width), [floats(1, patches, 2 * width)] * 4
    dense: dict[str, Any] = {"grid": grid, "image_size": image_size}
    calls = {
        "encoder": _ModuleCall(windows.encoder, (floats(1, *image_size, 3),)),
        "aggregator": _ModuleCall(
            windows.aggregator, (floats(1, 1, patches, width), lengths, first, memory), {"grid": grid}
        ),
        "camera_head": _ModuleCall(refinement.camera_head, (camera, lengths)),
        "depth_head": _ModuleCall(windows.depth_head, (levels,), dense),
        "gccr": _ModuleCall(refinement.gccr, (camera, floats(1, 1, registers, 2 * width), lengths)),
    }
    if config.point_head is not None:
        calls["point_head"] = _ModuleCall(windows.point_head, (levels,), dense)
    return calls


def _drawn(call: _ModuleCall, key: jax.Array) -> Any:
    """Random parameters of a module.

    It is traced, while generators run as they are met (`ShapeCheck.param`): they compile once a shape, where a jitted
    program would inline one for each parameter. Linen's `lazy_init` would compile an empty program for each operation.
    """
    if isinstance(key, jax.core.Tracer):
        return call.module.lazy_init(key, *call.inputs, **call.static)["params"]
    drawn = []

    def trace(*inputs: Any) -> None:
        drawn.append(call.module.init(key, *inputs, **call.static)["params"])

    jax.eval_shape(trace, *call.inputs)
    return jax.tree.map(jnp.asarray, drawn[0])


@functools.lru_cache(maxsize=16)
def _one_of_each_layer(config: ModelConfig) -> Variables:
    """Shapes of the parameters of a shallow model, in which one layer of each family stands for the stack."""
    patch, key = config.encoder.patch_size, jax.eval_shape(jax.random.key, 0)
    params = {
        name: jax.eval_shape(functools.partial(call.module.init, **call.static), key, *call.inputs)["params"]
        for name, call in _module_calls(config, (patch, patch)).items()
    }

    def stacked(layers: Any) -> Any:
        return {re.sub(r"block_0$", "blocks", name): x for name, x in layers.items() if not re.search(_LATER, name)}

    return {**params, "encoder": stacked(params["encoder"]), "aggregator": stacked(params["aggregator"])}
