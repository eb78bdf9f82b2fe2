"""What a step costs: its operations, by what is trained; its memory and exchanges, by what the compiler says."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import pytest

from logvggt_jax import ModelConfig
from logvggt_jax.operations import count_flops
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import data_mesh
from logvggt_jax.training.step import costs as module
from logvggt_jax.training.step.costs import StepCosts, abstract_clips, collectives, step_costs, step_flops

SIZE = (28, 42)


def test_operations_grow_with_the_clips_and_what_is_trained(
    small_config: ModelConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixed, moved = (
        dataclasses.replace(small_config, encoder=dataclasses.replace(small_config.encoder, frozen=frozen))
        for frozen in (True, False)
    )
    counted: list[float] = []
    monkeypatch.setattr(module, "count_flops", lambda *given: counted.append(count_flops(*given)) or counted[-1])
    one, four = (step_flops(fixed, (clips, 2, *SIZE)) for clips in (1, 4))
    assert four == pytest.approx(4 * one, rel=1e-3)
    forward, encoder = counted[:2]
    assert 0 < encoder < forward and one == 3 * forward - 2 * encoder
    monkeypatch.setattr(module, "count_flops", lambda *_: counted.pop(0))
    assert step_flops(moved, (1, 2, *SIZE)) == 3 * forward


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
