"""What a frame costs: counts, which depend on no machine. Times are the business of benchmarks/efficiency.py."""

import dataclasses
import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.evaluation.costs.parts import (
    Part,
    flops_by_part,
    live_device_bytes,
    sequence_parts,
    time_part,
)
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.operations import count_flops, matmul_flops_per_second

ROOT = Path(__file__).parents[2]
TINY_SIZE = (56, 70)


def with_refinement(config: ModelConfig, **options: object) -> LogVGGT:
    settings = dataclasses.replace(config.refinement, **options)  # type: ignore[arg-type]
    return LogVGGT(dataclasses.replace(config, refinement=settings, attention="xla"))


@pytest.fixture(scope="module")
def tiny() -> ModelConfig:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        return ModelConfig.from_dict(importlib.import_module("configs.tiny").get_config().to_dict()["model"])


@pytest.mark.parametrize("mode", [{"period": None}, {"period": 2}], ids=["full", "online"])
def test_a_frame_of_a_thousand_costs_what_one_of_a_hundred_does(tiny: ModelConfig, mode: dict) -> None:
    model = with_refinement(tiny, context=tiny.windows.size, **mode)
    short, long = (sum(flops_by_part(model, frames, TINY_SIZE).values()) / frames for frames in (100, 1000))
    assert 1.0 < long / short <= 1.03


@pytest.mark.parametrize(
    "options",
    [{}, {"period": 2, "context": 4}, {"period": 5}, {"enabled": False, "context": 3}],
    ids=["full", "online, limited trunk", "periodic", "no GCCR"],
)
def test_parts_add_up_to_the_whole_model(small_config: ModelConfig, options: dict) -> None:
    model = with_refinement(small_config, **options)
    images = jax.ShapeDtypeStruct((1, 13, 28, 42, 3), jnp.uint8)
    whole = count_flops(model.apply, variable_shapes(model.config), images)
    parts = flops_by_part(model, 13, (28, 42))
    assert sum(parts.values()) == pytest.approx(whole, rel=0.01)
    assert (parts["GCCR"] > 0) == model.config.refinement.enabled


def test_gccr_is_below_a_hundredth_of_vggt_1b() -> None:
    """On shapes alone: a thousand frames of 392 x 518, GCCR against the backbone, the largest part."""
    model = LogVGGT(ModelConfig(dtype="bfloat16", attention="xla"))
    variables = variable_shapes(model.config)
    parts = [part for part in sequence_parts(model, 1000, (392, 518)) if part.name in ("backbone", "GCCR")]
    counts = dict.fromkeys(("backbone", "GCCR"), 0.0)
    for part in parts:
        counts[part.name] += part.calls * count_flops(part.function, variables, *part.arguments)
    # Two passes a frame of 24 frame and 24 global blocks, see the estimate of 2.5 + 0.9 TFLOP.
    assert 3.0e15 < counts["backbone"] < 4.5e15 and 0 < counts["GCCR"] < 0.01 * counts["backbone"]


def test_timing_compiles_once_and_counts_calls() -> None:
    traced = []

    def function(variables: jax.Array, x: jax.Array, mask: jax.Array) -> jax.Array:
        traced.append(x.shape)
        return jnp.where(mask, x @ variables, 0)

    shapes = (jax.ShapeDtypeStruct((8, 8), jnp.float32), jax.ShapeDtypeStruct((8, 8), bool))
    result = time_part(Part("GCCR", function, shapes, 7), jnp.eye(8), rounds=3, least_seconds=0.001)
    assert traced == [(8, 8)] and result.calls == 7
    assert result.median > 0 and result.compilation > 0


def test_measures_are_positive() -> None:
    assert matmul_flops_per_second("float32", size=64, rounds=2) > 0
    before = live_device_bytes()
    held = jax.device_put(jnp.ones((1000,), jnp.float32))
    assert live_device_bytes() == before + held.nbytes
