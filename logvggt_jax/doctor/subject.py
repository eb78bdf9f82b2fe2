"""The model that is examined: VGGT-1B's sizes on an accelerator, a tiny one on a CPU; random parameters."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from logvggt_jax.config import (
    AggregatorConfig,
    CameraHeadConfig,
    DPTConfig,
    EncoderConfig,
    ModelConfig,
    RefinementConfig,
)
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.logvggt import LogVGGT

# Values that parameters are cut from: a generator for each of a thousand shapes would compile for minutes.
_BLOCK = 1 << 22


@dataclasses.dataclass(frozen=True)
class Subject:
    """A model, images of (H, W) pixels for it, and how long a measurement may be (`quick`: shorter)."""

    model: LogVGGT
    image_size: tuple[int, int]
    tiny: bool
    quick: bool


def tiny_config(dtype: str = "float32") -> ModelConfig:
    """A model of about 0.2 M parameters that has every part."""
    return ModelConfig(
        encoder=EncoderConfig(embed_dim=32, depth=1, num_heads=2, position_grid=4),
        aggregator=AggregatorConfig(depth=4, num_heads=2, key_layers=(0, 1, 2, 3), layer_scale=0.5),
        camera_head=CameraHeadConfig(depth=1, num_heads=2, layer_scale=0.5),
        depth_head=DPTConfig(features=8, out_channels=(8, 8, 8, 8)),
        refinement=RefinementConfig(num_heads=2),
        dtype=dtype,
    )


def subject(*, tiny: bool, quick: bool) -> Subject:
    """What is measured: `tiny` on request, and always on a CPU."""
    tiny = tiny or jax.default_backend() == "cpu"
    config = tiny_config("bfloat16") if tiny else ModelConfig(dtype="bfloat16")
    return Subject(LogVGGT(config), (28, 42) if tiny else (392, 518), tiny, quick)


def random_variables(model: LogVGGT, *, scale: float = 0.02) -> dict[str, Any]:
    """Parameters {"params": …} as float32 numpy arrays, the same on every machine.

    They are cut from one block of normal numbers of this standard deviation; gains of norms are moved up by one.
    """
    block = scale * np.random.default_rng(0).standard_normal(_BLOCK, np.float32)
    offset = 0

    def cut(path: tuple[Any, ...], leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        nonlocal offset
        size = math.prod(leaf.shape)
        # A view of the block where it is long enough: thousands of small parameters cost no memory of their own.
        start = offset if offset + size <= _BLOCK else 0
        values = (block[start : start + size] if size <= _BLOCK else np.resize(block, size)).reshape(leaf.shape)
        offset = (start + size) % _BLOCK
        return values + np.float32(1.0) if path[-1].key == "scale" else values

    return jax.tree_util.tree_map_with_path(cut, variable_shapes(model.config))
