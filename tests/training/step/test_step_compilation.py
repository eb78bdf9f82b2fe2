"""A stage's steps are compiled before its first one: for the sizes that occur, several at a time, with progress."""

import dataclasses
import re
import threading
from pathlib import Path
from typing import Any

import jax
import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.training import loop
from logvggt_jax.training.config import TeacherConfig, TrainConfig
from logvggt_jax.training.feeding.batches import stage_batches
from logvggt_jax.training.feeding.sources import open_sources
from logvggt_jax.training.loop import train
from logvggt_jax.training.parallel.sharding import data_mesh, put_batch
from logvggt_jax.training.step import compilation, train_step
from logvggt_jax.training.step.compilation import compiled_steps
from logvggt_jax.training.step.program import make_program

SIZES = ((28, 42), (42, 28), (28, 28))


@pytest.fixture
def program(run_config: TrainConfig, pixel_model: Any, pixel_params: Any) -> Any:
    return make_program(pixel_model, run_config, jax.eval_shape(lambda: pixel_params), data_mesh(2))


def test_each_size_has_a_step_that_takes_its_clips(
    run_config: TrainConfig, program: Any, pixel_params: Any, clips: Any
) -> None:
    stage = dataclasses.replace(run_config.stages[0], batch_size=8, clip_length=5)
    state = program.initial_state(pixel_params)
    steps = {step.clips: step for step in compiled_steps(program, state, stage, SIZES[:2])}
    assert set(steps) == {(8, 5, *size, 3) for size in SIZES[:2]}
    batch = put_batch({name: value for name, value in clips.items() if name != "frame_mask"}, data_mesh(2))
    state, metrics, _ = steps[batch["images"].shape].run(state, batch)
    assert int(state.step) == 1 and float(metrics["loss/total"]) > 0


def test_steps_are_compiled_with_the_devices_options(
    run_config: TrainConfig, pixel_model: Any, pixel_params: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[jax.Device] = []
    monkeypatch.setattr(train_step, "quick_compilation", lambda device: asked.append(device) or {"xla_no_such": True})
    mesh = data_mesh(2)
    program = make_program(pixel_model, run_config, jax.eval_shape(lambda: pixel_params), mesh)
    assert asked == [mesh.devices.flat[0]]
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such"):
        next(compiled_steps(program, program.abstract_state, run_config.stages[0], SIZES[:1]))


def test_the_step_of_a_distillation_takes_clips_with_the_teachers_confidence(
    run_config: TrainConfig, pixel_model: Any, pixel_params: Any, tmp_path: Path
) -> None:
    config = dataclasses.replace(
        run_config,
        loss=dataclasses.replace(run_config.loss, name="distillation"),
        data=dataclasses.replace(run_config.data, cache_dir=str(tmp_path)),
        teacher=TeacherConfig("anything", clip_length=4),
    )
    taught = make_program(pixel_model, config, jax.eval_shape(lambda: pixel_params), data_mesh(1))
    state = taught.abstract_state
    (step,) = compiled_steps(taught, state, config.stages[0], SIZES[:1], taught=True)
    assert step.run.in_avals[0][1]["confidence"].shape == step.clips[:4]
    with pytest.raises(InputError, match="a teacher's confidence, which these clips lack"):
        next(compiled_steps(taught, state, config.stages[0], SIZES[:1]))


def test_sizes_are_compiled_at_the_same_time(
    run_config: TrainConfig, program: Any, pixel_params: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation.os, "cpu_count", lambda: 3)
    together = threading.Barrier(3, timeout=30)

    class Meeting:
        def lower(self, *_: Any) -> Any:
            return self

        def compile(self) -> Any:
            together.wait()

    met = program._replace(step=Meeting())
    state = program.abstract_state
    assert len(list(compiled_steps(met, state, run_config.stages[0], SIZES))) == 3


def test_only_sizes_that_occur_are_compiled_before_the_first_step_and_the_terminal_says_so(
    run_config: TrainConfig,
    pixel_model: Any,
    pixel_params: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(loop, "LogVGGT", lambda _: pixel_model)
    monkeypatch.setattr(loop, "initial_parameters", lambda *_, **__: pixel_params)
    monkeypatch.setattr(loop, "abstract_parameters", lambda _: jax.eval_shape(lambda: pixel_params))
    stages = tuple(dataclasses.replace(stage, sizes=((42, 28), (28, 42))) for stage in run_config.stages)
    config = dataclasses.replace(run_config, stages=stages)
    with stage_batches(open_sources(config.data), config.data, stages[0], seed=0) as batches:
        assert batches.sizes == ((28, 42),), "the rooms are as wide"
    train(config, tmp_path, mesh=data_mesh(2))
    lines = capsys.readouterr().out.splitlines()
    said = [line.split(":")[0] if "compiled" in line else line.split("/")[0] for line in lines if "step" in line]
    assert said[1:3] == ["first", "step 1"] and said.index("second") == said.index("step 4") + 1
    assert (
        sum(bool(re.search(r"step for images of 28 x 42 compiled after \d+ s, 1 of 1$", line)) for line in lines) == 2
    )
