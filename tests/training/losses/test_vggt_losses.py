"""The losses of VGGT's released trainer against its own values."""

import functools
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.training.losses import vggt as vggt_losses
from logvggt_jax.training.losses.normalization import Targets, normalize_clips

# As programs, which training runs: one by one each operation would compile by itself.
camera_losses = jax.jit(vggt_losses.camera_losses, static_argnames="gamma")
depth_losses = jax.jit(vggt_losses.depth_losses, static_argnames=("alpha", "quantile"))

Golden = tuple[Any, dict[str, Any], Targets]


@pytest.fixture(scope="module")
def golden(golden_dir: Path) -> Golden:
    arrays = np.load(golden_dir / "vggt_losses.npz")
    losses = json.loads((golden_dir / "vggt_losses.json").read_text())["losses"]
    targets = jax.jit(normalize_clips)(*(jnp.asarray(arrays[name]) for name in ("depths", "intrinsics", "extrinsics")))
    return arrays, losses, targets


def test_camera_losses(golden: Golden) -> None:
    arrays, losses, targets = golden
    rounds = jnp.moveaxis(jnp.asarray(arrays["pred_pose_enc"]), 0, 2)
    found = camera_losses(rounds, targets.pose_encoding, targets.frame_valid, targets.depth_valid, gamma=0.6)
    for name, key in (("translation", "loss_T"), ("rotation", "loss_R"), ("field_of_view", "loss_FL")):
        assert float(found[f"camera_{name}"].value()) == pytest.approx(losses["grad"][key], rel=1e-5)


@pytest.mark.parametrize(("options", "case"), [({}, "grad"), ({"quantile": None}, "depth_no_quantile")])
def test_depth_losses(golden: Golden, options: dict[str, Any], case: str) -> None:
    arrays, losses, targets = golden
    depth, confidence = jnp.asarray(arrays["pred_depth"][..., 0]), jnp.asarray(arrays["pred_depth_conf"])
    found = depth_losses(depth, confidence, targets.depth, targets.depth_valid, alpha=0.2, **options)
    for name, key in (("confidence", "conf"), ("regression", "reg"), ("gradient", "grad")):
        assert float(found[f"depth_{name}"].value()) == pytest.approx(losses[case][f"loss_{key}_depth"], rel=1e-5)


@pytest.mark.parametrize("quantile", [0.98, 0.5, 0.29, 1.0])
def test_a_quantiles_rank_is_right_for_any_number_of_pixels(quantile: float) -> None:
    counts = np.array([0, 1, 2, 51, 101, 12_345, 21_913_100, 30_000_000, 2**31 - 1], np.int32)
    found = jax.vmap(functools.partial(vggt_losses.quantile_rank, quantile=quantile))(counts)
    expected = [round(Fraction(round(100 * quantile), 100) * (max(int(count), 1) - 1)) for count in counts]
    assert found.dtype == np.int32 and found.tolist() == expected


def test_fewer_than_a_hundred_pixels_count_as_none() -> None:
    shape, valid = (1, 1, 20, 20), np.zeros((1, 1, 20, 20), bool)
    valid.flat[:99] = True
    ones = jnp.ones(shape)
    few = depth_losses(2 * ones, 2 * ones, ones, jnp.asarray(valid), alpha=0.2)
    valid.flat[99] = True
    enough = depth_losses(2 * ones, 2 * ones, ones, jnp.asarray(valid), alpha=0.2)
    assert all(float(term.value()) == 0.0 for term in few.values())
    assert float(enough["depth_regression"].value()) == pytest.approx(1.0)
