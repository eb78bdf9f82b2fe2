"""The originals' outputs of the long-sequence methods, and the network with the weights that they were run with."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from logvggt_jax import ModelConfig
from logvggt_jax.config import AggregatorConfig, CameraHeadConfig, DPTConfig, EncoderConfig, RefinementConfig
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


def load(golden_dir: Path, name: str, model: str = "") -> Golden:
    """The file `name`.npz, with weights that are made from their names alone; of two models in it the one that `model`
    names."""
    spec = importlib.util.spec_from_file_location("make_vggt_weights", golden_dir / "make_vggt_weights.py")
    assert spec is not None and spec.loader is not None
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    with np.load(golden_dir / "methods" / f"{name}.npz") as file:
        arrays = dict(file)
    settings = json.loads(str(arrays["config"]))
    sizes = settings[f"{model}_config"] if model else settings
    state_dict = dict(maker.weights(json.loads(str(arrays[f"{model}_shapes" if model else "shapes"]))))
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


def assert_depth(found: np.ndarray, expected: np.ndarray) -> None:
    """Depth or confidence: 2e-5 and 1e-5 of the value."""
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)
