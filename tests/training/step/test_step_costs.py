"""What a step costs: its operations, by what is trained; its memory and exchanges, by what the compiler says."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from logvggt_jax import LogVGGT
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.operations import count_flops
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import data_mesh
from logvggt_jax.training.step import costs as module
from logvggt_jax.training.step.costs import StepCosts, abstract_clips, collectives, step_costs, step_flops
from logvggt_jax.training.step.freezing import ENCODER, frozen_patterns

SIZE = (28, 42)


def test_operations_grow_with_the_clips_and_what_is_trained(run_config: TrainConfig) -> None:
    def flops(clips: int, *, encoder: bool = True, frozen: tuple[str, ...] = ()) -> float:
        parts = dataclasses.replace(run_config.model.encoder, frozen=encoder)
        config = dataclasses.replace(
            run_config,
            model=dataclasses.replace(run_config.model, encoder=parts),
            optimizer=dataclasses.replace(run_config.optimizer, frozen=frozen),
        )
        return step_flops(config.model, (clips, 4, *SIZE), frozen=frozen_patterns(config))

    model = LogVGGT(run_config.model)
    images = jax.ShapeDtypeStruct((1, 4, *SIZE, 3), jnp.uint8)
    functions = (model.apply, model.windows.encode)
    forward, encoder = (count_flops(function, variable_shapes(run_config.model), images) for function in functions)
    # The gradient of a product is two of the kind, and of one with a constant (a map is resized by such) but one.
    moved, fixed = flops(3, encoder=False), flops(1, encoder=False, frozen=(ENCODER,))
    assert moved == pytest.approx(9 * forward, rel=0.05) and moved < 9 * forward
    assert fixed == pytest.approx(3 * forward - 2 * encoder, rel=0.05) and fixed < 3 * forward - 2 * encoder

    # Kernels with something trained before them lose their own product alone; the other setting freezes the encoder
    # just as well.
    sizes, width = run_config.model.aggregator, run_config.model.encoder.embed_dim
    tokens = 4 * (2 * 3 + 1 + run_config.model.encoder.num_registers)
    products = 2.0 * tokens * width * sizes.mlp_ratio * width * 2 * sizes.depth
    assert fixed - flops(1, frozen=("aggregator/*_blocks/mlp/fc1/kernel",)) == products
    # What comes before all that is trained is not gone through backwards.
    assert forward < flops(1, frozen=("aggregator/*", "depth_head/*")) < forward + 0.1 * (fixed - forward)


def test_what_the_compiler_refuses_does_not_fit(
    run_config: TrainConfig, pixel_model: Any, pixel_params: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Ran out of memory in memory space hbm")

    monkeypatch.setattr(module, "LogVGGT", lambda _: pixel_model)
    monkeypatch.setattr(module, "abstract_parameters", lambda _: jax.eval_shape(lambda: pixel_params))
    monkeypatch.setattr(jax.stages.Lowered, "compile", refuse)
    assert step_costs(run_config, data_mesh(1), 1, 2, SIZE) is None


def test_collectives_are_counted_as_often_as_they_run() -> None:
    program = """
%body (p: f32[8]) -> f32[8] {
  %p = f32[8]{0} parameter(0)
  %start = (f32[2]{0}, f32[8]{0}) all-gather-start(%p)
  ROOT %done = f32[8]{0} all-gather-done(%start)
}

%fused (q: f32[8]) -> f32[4] {
  %q = f32[8]{0} parameter(0)
  ROOT %r = f32[4]{0} reduce-scatter(%q)
}

ENTRY %main (a: f32[8]) -> f32[] {
  %a = f32[8]{0} parameter(0)
  %all-reduce.1 = (f32[10,2]{1,0}, bf16[3]{0}) all-reduce(%a, %b), replica_groups={{0,1}}
  %loop = f32[8]{0} while(%a), condition=%c, body=%body, backend_config={"known_trip_count":{"n":"24"}}
  %parts = f32[4]{0} fusion(%loop), kind=kCustom, calls=%fused
  %all-reduce-start = f32[] all-reduce-start(%parts)
  ROOT %all-reduce-done = f32[] all-reduce-done(%all-reduce-start)
}
"""
    assert collectives(program) == {
        "all-reduce": (2, 80 + 6 + 4),
        "all-gather": (24, 24 * 32),
        "reduce-scatter": (1, 16),
    }


@pytest.mark.parametrize(
    "branches", ["branch_computations={%none, %all}", "true_computation=%all, false_computation=%none"]
)
def test_of_a_condition_the_longest_branch_is_counted(branches: str) -> None:
    program = f"""
%none (a: f32[8]) -> f32[8] {{
  ROOT %a = f32[8]{{0}} parameter(0)
}}

%all (b: f32[8]) -> f32[8] {{
  %b = f32[8]{{0}} parameter(0)
  ROOT %c = f32[8]{{0}} all-reduce(%b)
}}

ENTRY %main (x: f32[8], p: s32[]) -> f32[8] {{
  %x = f32[8]{{0}} parameter(0)
  ROOT %y = f32[8]{{0}} conditional(%p, %x, %x), {branches}
}}
"""
    assert collectives(program) == {"all-reduce": (1, 32)}


def test_clips_have_the_shapes_of_a_batch() -> None:
    batch = abstract_clips(2, 3, SIZE)
    assert {name: value.shape[:2] for name, value in batch.items()} == dict.fromkeys(batch, (2, 3))


def test_a_step_fits_where_its_arguments_and_temporaries_do() -> None:
    step = StepCosts(arguments=5, temporaries=20, collectives={}, compilation=0.0)
    assert [step.fits(limit) for limit in (24, 25, None)] == [False, True, True]
