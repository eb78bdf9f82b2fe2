"""A preflight tries what a run will need, names what fails, and leaves nothing behind."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from pixel_teacher import PixelTeacher

from logvggt_jax.data.registry import open_dataset
from logvggt_jax.errors import DiskError, InputError
from logvggt_jax.training import preflight as module
from logvggt_jax.training.checkpoints.checkpoint_files import Position, write_checkpoint
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.checkpoints.work_folder import PREFLIGHT
from logvggt_jax.training.config import TeacherConfig, TrainConfig, ValidationConfig
from logvggt_jax.training.parallel.sharding import data_mesh
from logvggt_jax.training.preflight import preflight
from logvggt_jax.training.step import initialization
from logvggt_jax.training.step.costs import StepCosts
from logvggt_jax.training.step.program import make_program
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import read_config


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What is compiled, which takes a minute, is only asked for."""
    asked: list[tuple[Any, ...]] = []

    def costs(config: TrainConfig, mesh: Any, *shape: Any) -> StepCosts:
        asked.append(shape)
        return StepCosts(arguments=2**30, temporaries=2**30, collectives={}, compilation=1.0)

    monkeypatch.setattr(module, "step_costs", costs)
    return asked


def test_everything_is_tried_and_nothing_is_left(
    run_config: TrainConfig, compiled: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    lines: list[str] = []
    preflight(run_config, tmp_path, data_mesh(2), lines.append)
    assert [line.split(":")[0] for line in lines] == [
        "all-reduce", "work folder", "data sets", "rooms", "checkpoint", "step of first", "step of second", "preflight",
    ]  # fmt: skip
    assert "64 MiB over 2 devices" in lines[0]
    assert lines[1].startswith(f"work folder: a run begins in {tmp_path}")
    assert "20 clips of 2 frames" in lines[3] and "0 broken" in lines[3]
    assert lines[-1] == "preflight: all is well"
    assert compiled == [(1, 2, (28, 42)), (1, 3, (28, 42))]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("writable", [True, False])
def test_of_a_teachers_clips_one_is_labelled(
    run_config: TrainConfig,
    compiled: list[tuple[Any, ...]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    writable: bool,
) -> None:
    cache, teacher = tmp_path / "cache", PixelTeacher()
    if not writable:
        cache.write_text("a file")
    monkeypatch.setattr(module, "PlainVGGT", lambda _: teacher)
    monkeypatch.setattr(module, "_checkpoint", lambda *_: "written")
    config = dataclasses.replace(
        run_config,
        loss=dataclasses.replace(run_config.loss, name="distillation"),
        data=dataclasses.replace(run_config.data, cache_dir=str(cache)),
        teacher=TeacherConfig("anything", clip_length=4),
    )
    lines: list[str] = []
    if not writable:
        # Rooms are kept there too.
        with pytest.raises(InputError, match="2 of the tries failed: data sets, teacher"):
            preflight(config, tmp_path, data_mesh(1), lines.append)
        return
    preflight(config, tmp_path, data_mesh(1), lines.append)
    assert [line.split(":")[0] for line in lines[2:6]] == ["data sets", "teacher", "labels", "rooms"]
    assert "one clip a process labelled; rooms, with clips for every stage" in lines[4]
    assert "20 clips of 2 frames" in lines[5] and "0 broken" in lines[5]
    assert teacher.calls == len(list((cache / "teacher").iterdir())) == 1


@pytest.mark.parametrize("clip_length", [4, 5])
def test_clips_of_validation_are_no_longer_than_those_of_the_teacher_that_labels_them(
    clip_length: int, run_config: TrainConfig
) -> None:
    config = dataclasses.replace(
        run_config,
        loss=dataclasses.replace(run_config.loss, name="distillation"),
        data=dataclasses.replace(run_config.data, cache_dir="cache"),
        teacher=TeacherConfig("anything", clip_length=4),
    )
    settings = _validated(run_config, clip_length)
    if clip_length == 4:
        assert "to be labelled" in module._validation(config, settings, data_mesh(1))
        return
    with pytest.raises(InputError, match="validation: data set 'rooms' has 0 sequences of at least 5 frames"):
        module._validation(config, settings, data_mesh(1))


def _validated(config: TrainConfig, clip_length: int) -> ValidationConfig:
    source = dataclasses.replace(config.data.sources[0], split="val")
    return ValidationConfig((source,), every=3, num_clips=2, clip_length=clip_length, stride=1, size=(28, 42))


@pytest.fixture
def begun(run_config: TrainConfig, pixel_model: Any, pixel_params: Any, tmp_path: Path) -> Path:
    """The folder of a run that has done three steps."""
    state = make_program(pixel_model, run_config, pixel_params, data_mesh(1)).initial_state(pixel_params)
    after = jax.device_get(state)._replace(step=np.int32(3))
    write_checkpoint(tmp_path / "begun" / "checkpoints" / "3", after, Position(0, {}), run_config)
    return tmp_path / "begun"


def test_what_would_end_a_run_at_once_is_named(
    run_config: TrainConfig,
    compiled: list[tuple[Any, ...]],
    begun: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_checkpoint", lambda *_: "written")
    other = dataclasses.replace(
        run_config, seed=7, initial_weights=str(tmp_path / "none"), validation=_validated(run_config, 9)
    )
    lines: list[str] = []
    with pytest.raises(InputError, match="3 of the tries failed: work folder, initial weights, validation"):
        preflight(other, begun, data_mesh(1), lines.append)
    failed = [line for line in lines if "FAILED" in line]
    for line, reason in zip(failed, ("seed=0, now 7", "no such file", "0 sequences of at least 9 frames"), strict=True):
        assert reason in line
    # A run that goes on does not look at its initial weights, which may be gone.
    lines.clear()
    preflight(
        dataclasses.replace(other, seed=0, validation=_validated(run_config, 8)), begun, data_mesh(1), lines.append
    )
    assert "work folder: a run goes on from step 3" in lines[1] and "not needed" in lines[2]
    assert any(line.startswith("validation: 2 clips of 8 frames at 28x42, read") for line in lines)


def test_initial_weights_of_other_sizes_are_named_and_no_parameter_is_read(
    run_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(initialization, "from_pretrained", lambda *_, **__: pytest.fail("the weights were read"))
    fitting = dataclasses.replace(run_config, model=read_config(resolve("rooms")))
    assert "rooms found" in module._initial_weights(fitting, "rooms", [])
    with pytest.raises(InputError, match=r"initial_weights=rooms: .* has shape .*, config\.model asks for"):
        module._initial_weights(run_config, "rooms", [])


def test_all_that_fails_is_named_at_the_end(
    run_config: TrainConfig,
    compiled: list[tuple[Any, ...]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object, **__: object) -> None:
        raise DiskError("no space left on device")

    def out_of_memory(*_: object) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr(RunCheckpoints, "save", full)
    monkeypatch.setattr(module, "device_bytes", lambda device: 2**30)
    monkeypatch.setattr(module, "_read_clips", full)
    monkeypatch.setattr(module, "_all_reduce", out_of_memory)
    lines: list[str] = []
    named = "all-reduce, rooms, checkpoint, step of first, step of second"
    with pytest.raises(InputError, match=f"5 of the tries failed: {named}"):
        preflight(run_config, tmp_path, data_mesh(2), lines.append)
    assert "all-reduce: FAILED on process 0: RESOURCE_EXHAUSTED: out of memory" in lines
    assert "checkpoint: FAILED on process 0: no space left on device" in lines
    assert any("do not fit the memory of a device" in line for line in lines)
    assert not list(tmp_path.iterdir())


def test_a_preflight_leaves_the_folder_of_another_one_alone(run_config: TrainConfig, tmp_path: Path) -> None:
    tried = tmp_path / PREFLIGHT
    with RunCheckpoints(tried, run_config), pytest.raises(InputError, match="another run is using this folder"):
        module._checkpoint(run_config, tmp_path, data_mesh(1))
    assert tried.is_dir()


def test_a_source_with_many_broken_clips_fails(run_config: TrainConfig) -> None:
    source = run_config.data.sources[0]
    dataset = open_dataset(source.name, None, source.split, **dict(source.options)).for_training(
        cache_dir=None, progress=False
    )

    class Flaky:
        def __getattr__(self, name: str) -> Any:
            return getattr(dataset, name)

        def read(self, sequence: str, indices: Any) -> Any:
            if 1 in indices:
                raise InputError(f"{sequence}: cannot be opened")
            return dataset.read(sequence, indices)

    with pytest.raises(InputError, match=r"of 20 clips are broken: .*cannot be opened"):
        module._read_clips(Flaky(), source, run_config)  # type: ignore[arg-type]
    tolerant = dataclasses.replace(run_config, data=dataclasses.replace(run_config.data, max_broken=0.9))
    assert "broken" in module._read_clips(Flaky(), source, tolerant)  # type: ignore[arg-type]
