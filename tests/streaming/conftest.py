"""Golden values of the original code of the methods that share VGGT's backbone."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from logvggt_jax import ModelConfig
from logvggt_jax.config import AggregatorConfig, CameraHeadConfig, DPTConfig, EncoderConfig, RefinementConfig
from logvggt_jax.weights import params_from_vggt


class GoldenMethod(NamedTuple):
    """What a method's original code made of a tiny model."""

    arrays: dict[str, np.ndarray]
    sizes: dict[str, Any]  # of the model, and the method's settings
    config: ModelConfig
    variables: dict


@pytest.fixture(scope="session")
def golden_method(golden_dir: Path) -> Callable[..., GoldenMethod]:
    """Opens `golden/methods/NAME.npz` with the weights that its names and shapes stand for; `model` is the name before
    `_shapes` and `_config` where the file holds two models."""
    spec = importlib.util.spec_from_file_location("make_vggt_weights", golden_dir / "make_vggt_weights.py")
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)

    def opened(name: str, model: str = "") -> GoldenMethod:
        with np.load(golden_dir / "methods" / f"{name}.npz") as file:
            arrays = dict(file)
        sizes = json.loads(str(arrays["config"]))
        sizes = sizes[f"{model}_config"] if model else sizes
        shapes = json.loads(str(arrays[f"{model}_shapes" if model else "shapes"]))
        state_dict = dict(maker.weights(shapes))
        config = ModelConfig(
            encoder=EncoderConfig(
                embed_dim=sizes["embed"],
                depth=sizes["dino_depth"],
                num_heads=sizes["dino_heads"],
                position_grid=sizes["img"] // 14,
            ),
            aggregator=AggregatorConfig(
                depth=sizes["depth"], num_heads=sizes["heads"], key_layers=tuple(sizes["layers"])
            ),
            camera_head=CameraHeadConfig(depth=sizes["cam_depth"], num_heads=sizes["cam_heads"]),
            depth_head=DPTConfig(features=sizes["feat"], out_channels=tuple(sizes["oc"])),
            refinement=RefinementConfig(num_heads=sizes["heads"]),
        )
        return GoldenMethod(arrays, sizes, config, {"params": params_from_vggt(state_dict, config)[0]})

    return opened
