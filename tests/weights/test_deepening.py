"""A model of twice as many blocks computes what the old one does, and every block of it can learn."""

from __future__ import annotations

import dataclasses
import runpy
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT
from logvggt_jax.config import ModelConfig
from logvggt_jax.weights.checkpoints import load_model, read_provenance, save_model
from logvggt_jax.weights.deepening import deepened
from logvggt_jax.weights.provenance import Provenance

SCRIPT = Path(__file__).parents[2] / "scripts" / "deepen_model.py"


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.random.default_rng(0).random((1, 6, 28, 42, 3), np.float32)


def test_a_deeper_model_computes_the_same_and_learns_everywhere(
    small_config: ModelConfig, small_variables: dict, images: np.ndarray
) -> None:
    small_config = dataclasses.replace(small_config, encoder=dataclasses.replace(small_config.encoder, frozen=False))
    config, params = deepened(small_config, small_variables["params"])
    assert config.aggregator.depth == 2 * small_config.aggregator.depth
    assert config.encoder.depth == 2 * small_config.encoder.depth
    expected = jax.jit(LogVGGT(small_config).apply)(small_variables, images)

    def loss(params: dict) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        seen = LogVGGT(config).apply({"params": params}, images)
        return seen.depth.sum() + seen.extrinsics.sum(), (seen.depth, seen.extrinsics)

    gradients, (depth, extrinsics) = jax.jit(jax.grad(loss, has_aux=True))(params)
    np.testing.assert_allclose(depth, expected.depth, rtol=1e-5)
    np.testing.assert_allclose(extrinsics, expected.extrinsics, atol=1e-5)
    for part, kind in (("encoder", "block"), ("aggregator", "frame_block"), ("aggregator", "global_block")):
        for number in range(getattr(config, part).depth):
            block = gradients[part][f"{kind}_{number}"]
            for branch, layer in (("attention", "output"), ("mlp", "fc2")):
                assert np.abs(block[branch][layer]["kernel"]).max() > 0, f"{part}/{kind}_{number}/{branch}"


def test_the_script_writes_a_folder_of_its_own(
    small_config: ModelConfig,
    small_variables: dict,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    save_model(tmp_path / "model", small_config, small_variables["params"], Provenance("windows", 42))
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), str(tmp_path / "model"), str(tmp_path / "deep")])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert f"{2 * small_config.aggregator.depth} pairs in the aggregator" in capsys.readouterr().out
    config, params = deepened(small_config, small_variables["params"])
    model, variables = load_model(tmp_path / "deep")
    assert model.config == config
    jax.tree.map(np.testing.assert_array_equal, variables["params"], params)
    provenance = read_provenance(tmp_path / "deep")
    assert provenance.longer_edge == 42 and "twice as many blocks" in provenance.source
    with pytest.raises(SystemExit, match=r"^deepen_model\.py: .*deep"):
        runpy.run_path(str(SCRIPT), run_name="__main__")
