"""The originals' outputs of the long-sequence methods, and the network with the weights that they were run with."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib.util
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from pieces import in_pieces

from logvggt_jax import ModelConfig
from logvggt_jax.config import AggregatorConfig, CameraHeadConfig, DPTConfig, EncoderConfig, RefinementConfig
from logvggt_jax.model.frame_by_frame import FrameByFrame
from logvggt_jax.model.windows import Windows
from logvggt_jax.streaming.frame_session import StreamMemory
from logvggt_jax.weights import params_from_vggt

TOKENS, POSES = 2e-5, 5e-6


@dataclasses.dataclass(frozen=True)
class Golden:
    """A file of `golden/methods`: its arrays, its settings, and the network, hashable for static arguments."""

    arrays: dict[str, np.ndarray] = dataclasses.field(hash=False)
    settings: dict[str, Any] = dataclasses.field(hash=False)
    config: ModelConfig
    variables: dict[str, Any] = dataclasses.field(hash=False)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def weight_maker(golden_dir: Path) -> Any:
    """The module that makes the originals' weights from their names and shapes."""
    spec = importlib.util.spec_from_file_location("make_vggt_weights", golden_dir / "make_vggt_weights.py")
    assert spec is not None and spec.loader is not None
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    return maker


def load(golden_dir: Path, name: str, model: str = "") -> Golden:
    """The file `name`.npz, with weights that are made from their names alone; of two models in it the one that `model`
    names."""
    with np.load(golden_dir / "methods" / f"{name}.npz") as file:
        arrays = dict(file)
    settings = json.loads(str(arrays["config"]))
    sizes = settings[f"{model}_config"] if model else settings
    state_dict = dict(
        weight_maker(golden_dir).weights(json.loads(str(arrays[f"{model}_shapes" if model else "shapes"])))
    )
    # Spelt out, since of a model of other depths than VGGT's the weights do not tell the key layers.
    config = ModelConfig(
        encoder=EncoderConfig(
            sizes["embed"], sizes["dino_depth"], sizes["dino_heads"], position_grid=sizes["img"] // 14
        ),
        aggregator=AggregatorConfig(sizes["depth"], sizes["heads"], key_layers=tuple(sizes["layers"])),
        camera_head=CameraHeadConfig(sizes["cam_depth"], sizes["cam_heads"]),
        depth_head=DPTConfig(sizes["feat"], tuple(sizes["oc"])),
        refinement=RefinementConfig(num_heads=sizes["heads"]),
    )
    params, _ = params_from_vggt(state_dict, config)
    return Golden(arrays, settings, config, jax.device_put({"params": params}))


def with_key_layers(config: ModelConfig, layers: Iterable[int], depth: int | None = None) -> ModelConfig:
    """The model whose aggregator gives the tokens of these layers, and has the first `depth` alone, if given. A
    configuration has the four that the depth head reads; the aggregator gives as many as it is asked for."""
    sizes = copy.copy(config.aggregator)
    object.__setattr__(sizes, "key_layers", tuple(layers))
    object.__setattr__(sizes, "depth", depth or sizes.depth)
    return dataclasses.replace(config, aggregator=sizes)


@functools.partial(in_pieces, static=1)
def frame_step(
    config: ModelConfig, variables: dict[str, Any], memory: StreamMemory, image: jax.Array, first: jax.Array
) -> tuple[StreamMemory, dict[str, jax.Array]]:
    """One frame [H, W, 3] through a memory: what is kept, and its numbers under a leading axis of 1."""
    parts, images = FrameByFrame(config), image[None, None]
    tokens, blocks = parts.tokens(variables, memory.blocks, images, first)
    out = Windows(config).decode_dense(variables, tokens, jnp.ones((1, 1), bool), images.shape[2:4])
    camera, poses = parts.locate(variables, memory.camera, out.camera_tokens, out.register_tokens)
    return StreamMemory(blocks, camera), {
        "tokens": jnp.moveaxis(tokens.key[0], 1, 0),
        "depth": out.depth[0],
        "depth_conf": out.depth_confidence[0],
        "poses": poses[0],
    }


def assert_depth(found: np.ndarray, expected: np.ndarray) -> None:
    """Depth or confidence: 2e-5 and 1e-5 of the value."""
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)
