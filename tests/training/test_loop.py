"""Runs: interrupted ones end like uninterrupted ones; damaged or foreign checkpoints are refused by name."""

import dataclasses
import multiprocessing
import os
import re
import shutil
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dazzled_model import DazzledModel
from jax.sharding import Mesh

from logvggt_jax.data.feeding.batches import BatchIterator
from logvggt_jax.data.feeding.clips import ClipReader
from logvggt_jax.data.registry import open_dataset
from logvggt_jax.errors import InputError
from logvggt_jax.interruption import StopRequest
from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.training import loop
from logvggt_jax.training.checkpoints import run_checkpoints
from logvggt_jax.training.checkpoints.checkpoint_files import Position
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.config import VALIDATION_METRICS, SourceConfig, StageConfig, TrainConfig, ValidationConfig
from logvggt_jax.training.feeding.device_batches import DeviceBatches
from logvggt_jax.training.loop import NonFiniteTraining, train
from logvggt_jax.training.parallel.sharding import data_mesh
from logvggt_jax.training.reporting.metrics_log import COST, TIMES_NAME, MetricsLog, read_metrics
from logvggt_jax.training.reporting.profile import ProfiledSteps
from logvggt_jax.training.step.freezing import frozen_patterns
from logvggt_jax.training.step.program import Program, make_program
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.training.validation.earlier import is_best
from logvggt_jax.training.validation.validation import Judgement
from logvggt_jax.weights.checkpoints import digests, load_model, read_provenance


@pytest.fixture(autouse=True)
def quick(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, pixel_model: Any, pixel_params: Any) -> None:
    """Runs use the model that compiles at once, but for those of tests that ask for the `real_model`."""
    if "real_model" not in request.fixturenames:
        _use(monkeypatch, pixel_model, pixel_params)
        monkeypatch.setattr(loop, "make_program", _program)


@pytest.fixture
def real_model() -> None:
    """Runs use LoG-VGGT."""


@pytest.fixture(scope="module")
def straight(
    run_config: TrainConfig, pixel_model: Any, pixel_params: Any, tmp_path_factory: pytest.TempPathFactory
) -> tuple[TrainState, Path]:
    """A run that nothing interrupts, on two devices: its last state and its folder."""
    workdir = tmp_path_factory.mktemp("straight")
    with pytest.MonkeyPatch.context() as patch:
        _use(patch, pixel_model, pixel_params)
        patch.setattr(loop, "make_program", _program)
        return train(run_config, workdir, mesh=data_mesh(2)), workdir


@pytest.fixture
def finished(straight: tuple[TrainState, Path], tmp_path: Path) -> Path:
    """A copy of the uninterrupted run's folder."""
    return Path(shutil.copytree(straight[1], tmp_path / "finished"))


def _use(patch: pytest.MonkeyPatch, model: Any, params: Any) -> None:
    patch.setattr(loop, "LogVGGT", lambda _: model)
    patch.setattr(loop, "initial_parameters", lambda *_, **__: jax.tree.map(jnp.array, params))
    patch.setattr(loop, "abstract_parameters", lambda _: jax.eval_shape(lambda: params))


_programs: dict[Any, Program] = {}


def _program(model: Any, config: TrainConfig, params: Any, mesh: Mesh) -> Program:
    """Runs whose steps are the same share one: most of a run's time is its compilation."""
    settings = (config.optimizer, config.loss, config.stages, config.accumulate, config.average)
    key = (model, mesh, config.model.encoder.frozen, config.shard_parameters, *settings)
    if key not in _programs:
        _programs[key] = make_program(model, config, params, mesh)
    return _programs[key]


def _at_step(monkeypatch: pytest.MonkeyPatch, step: int, action: Callable[[], None]) -> None:
    """Does `action` when the metrics of `step` are written."""
    write = MetricsLog.write

    def intercept(log: MetricsLog, at: int, values: dict[str, float], **words: str) -> None:
        write(log, at, values, **words)
        if at == step:
            action()

    monkeypatch.setattr(MetricsLog, "write", intercept)


def _crash() -> None:
    raise KeyError("crash")


def _numbers(workdir: Path) -> list[dict[str, Any]]:
    return read_metrics(workdir / "metrics.jsonl")


def _same(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


# Just after a stage has begun; in the middle of one, see test_kills.py, where the process is killed.
@pytest.mark.parametrize("kill_at", [pytest.param(4, marks=pytest.mark.slow), 5])
def test_killed_run_goes_on_to_the_same_numbers(
    run_config: TrainConfig, straight: tuple[TrainState, Path], tmp_path: Path, kill_at: int
) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _at_step(patch, kill_at, _crash)
        train(run_config, tmp_path, mesh=data_mesh(2))
    _same(train(run_config, tmp_path, mesh=data_mesh(2)), straight[0])
    assert _numbers(tmp_path) == _numbers(straight[1])
    assert [entry["step"] for entry in _numbers(tmp_path)] == [1, 2, 3, 4, 5, 6]


def test_a_killed_run_on_rooms_drawn_on_the_device_goes_on_to_the_same_numbers(
    run_config: TrainConfig, straight: tuple[TrainState, Path], tmp_path: Path
) -> None:
    (rooms,) = run_config.data.sources
    drawn = dataclasses.replace(rooms, options=(*rooms.options, ("renderer", "device")))
    config = dataclasses.replace(run_config, data=dataclasses.replace(run_config.data, sources=(drawn,)))
    whole = train(config, tmp_path / "whole", mesh=data_mesh(2))
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _at_step(patch, 5, _crash)
        train(config, tmp_path / "killed", mesh=data_mesh(2))
    _same(train(config, tmp_path / "killed", mesh=data_mesh(2)), whole)
    assert _numbers(tmp_path / "killed") == _numbers(tmp_path / "whole")
    # Pictures are equal to a grey level, and so are runs on them.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=5e-3), whole.params, straight[0].params)


def test_sigterm_saves_ends_cleanly_and_can_be_resumed(
    run_config: TrainConfig, straight: tuple[TrainState, Path], tmp_path: Path
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch:
        _at_step(patch, 1, lambda: os.kill(os.getpid(), signal.SIGTERM))
        stopped = train(run_config, tmp_path, mesh=data_mesh(2))
    assert 1 <= int(stopped.step) <= 2 and signal.getsignal(signal.SIGTERM) == before
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        assert checkpoints.steps == [0, int(stopped.step)]
    _same(train(run_config, tmp_path, mesh=data_mesh(2)), straight[0])


def test_second_ctrl_c_is_not_held_back() -> None:
    # A job started in the background may ignore SIGINT, and then a second one is ignored as well.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with StopRequest("SIGTERM", "SIGINT") as stop:
            os.kill(os.getpid(), signal.SIGINT)
            assert stop.reason == "SIGINT"
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_number_of_devices_may_change(
    run_config: TrainConfig, straight: tuple[TrainState, Path], finished: Path
) -> None:
    state = train(run_config, finished, mesh=data_mesh(1), resume_step=4)
    assert int(state.step) == 6 and len(state.step.devices()) == 1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), state.params, straight[0].params)


def test_data_that_do_not_fit_the_last_stage_are_an_error_before_the_first(
    run_config: TrainConfig, tmp_path: Path
) -> None:
    *stages, last = run_config.stages
    longer = dataclasses.replace(last, clip_length=9)  # than the rooms' eight frames
    with pytest.raises(ValueError, match="rooms: none of 8 sequences has"):
        train(dataclasses.replace(run_config, stages=(*stages, longer)), tmp_path, mesh=data_mesh(2))
    assert not _numbers(tmp_path)


def test_time_limit_ends_the_run_with_a_checkpoint(run_config: TrainConfig, tmp_path: Path) -> None:
    limited = dataclasses.replace(run_config, max_minutes=1e-9)
    # The limit belongs to a session, not to the run: each one gets a step further.
    assert int(train(limited, tmp_path, mesh=data_mesh(2)).step) == 1
    assert int(train(limited, tmp_path, mesh=data_mesh(2)).step) == 2


def test_finished_run_is_left_alone(run_config: TrainConfig, straight: tuple[TrainState, Path], finished: Path) -> None:
    _same(train(run_config, finished, mesh=data_mesh(2)), straight[0])
    assert _numbers(finished) == _numbers(straight[1])


def _at_constant_rate(config: TrainConfig, *stages: StageConfig) -> TrainConfig:
    """The run with these stages; what its first steps learn does not depend on how many follow."""
    rate = config.optimizer.learning_rate
    optimizer = dataclasses.replace(config.optimizer, final_learning_rate=rate, warmup_fraction=0.0)
    return dataclasses.replace(config, optimizer=optimizer, stages=stages)


@pytest.fixture(scope="module")
def at_constant_rate(run_config: TrainConfig, pixel_model: Any, pixel_params: Any, tmp_path_factory: Any) -> Path:
    """The folder of a finished run of two stages."""
    workdir = Path(tmp_path_factory.mktemp("constant"))
    with pytest.MonkeyPatch.context() as patch:
        _use(patch, pixel_model, pixel_params)
        patch.setattr(loop, "make_program", _program)
        train(_at_constant_rate(run_config, *run_config.stages), workdir, mesh=data_mesh(2))
    return workdir


@pytest.mark.parametrize("added", [True, False])
def test_a_finished_run_that_is_to_go_further_trains_the_new_steps_and_no_others(
    run_config: TrainConfig, at_constant_rate: Path, tmp_path: Path, added: bool
) -> None:
    workdir = Path(shutil.copytree(at_constant_rate, tmp_path / "finished"))
    first, last = run_config.stages
    more = (last, dataclasses.replace(last, name="third")) if added else (dataclasses.replace(last, steps=4),)
    config = _at_constant_rate(run_config, first, *more)
    state = train(config, workdir, mesh=data_mesh(2))
    # Times and all.
    assert read_metrics(workdir / "metrics.jsonl")[:6] == read_metrics(at_constant_rate / "metrics.jsonl")
    _same(state, train(config, tmp_path / "whole", mesh=data_mesh(2)))
    assert _numbers(workdir) == _numbers(tmp_path / "whole")
    training = read_provenance(workdir / "model").training
    assert training is not None and training.steps == 8
    # And is finished again.
    _same(train(config, workdir, mesh=data_mesh(2)), state)


def test_other_changes_of_stages_are_refused(run_config: TrainConfig, finished: Path) -> None:
    first, last = run_config.stages
    third = dataclasses.replace(last, name="third")
    longer = [dataclasses.replace(stage, steps=8) for stage in run_config.stages]
    for stages, step, named in (
        # Where it is not finished.
        ((first, last, third), 4, r"stages=\['first', 'second'\], now \['first', 'second', 'third'\]"),
        ((longer[0], last), None, r"stages\[0\]\.steps=4, now 8"),
        ((first, longer[1], third), None, "stages"),
        ((first, dataclasses.replace(last, steps=1)), None, r"stages\[1\]\.steps=2, now 1"),
        ((first, dataclasses.replace(longer[1], clip_length=2)), None, r"stages\[1\]\.clip_length=3, now 2"),
    ):
        config = dataclasses.replace(run_config, stages=stages)
        with pytest.raises(InputError, match=rf"other settings: {named}.*\(a finished run may get stages after"):
            train(config, finished, mesh=data_mesh(2), resume_step=step)


@pytest.mark.usefixtures("abandoned_reads")
def test_run_whose_newest_checkpoint_is_damaged_ends_the_same(
    run_config: TrainConfig, straight: tuple[TrainState, Path], finished: Path
) -> None:
    files = [path for path in (finished / "checkpoints" / "6" / "params").rglob("*") if path.is_file()]
    largest = max(files, key=lambda path: path.stat().st_size)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    _same(train(run_config, finished, mesh=data_mesh(2)), straight[0])
    assert _numbers(finished) == _numbers(straight[1])
    assert (finished / "checkpoints" / "6.aside").is_dir()


def test_changed_leaf_is_refused_by_its_digest(
    run_config: TrainConfig, straight: tuple[TrainState, Path], tmp_path: Path
) -> None:
    state = straight[0]
    true = digests(state.params)
    with RunCheckpoints(tmp_path, run_config) as checkpoints, pytest.MonkeyPatch.context() as patch:
        # What Orbax stores differs from what was digested, as after a flipped byte.
        patch.setattr("logvggt_jax.training.checkpoints.checkpoint_files.digests", lambda tree: true)
        wrong = {**state.params, "camera_head": jax.tree.map(lambda x: x + 1, state.params["camera_head"])}
        checkpoints.save(state._replace(params=wrong), Position(1, {}))
        checkpoints.wait()
        with pytest.raises(ValueError, match=r"step 6 .*leaf camera_head/bias differs from its digest"):
            checkpoints.restore(state)


def test_checkpoint_of_another_configuration_is_refused(run_config: TrainConfig, finished: Path) -> None:
    other = dataclasses.replace(run_config, loss=dataclasses.replace(run_config.loss, alpha=0.5), seed=1)
    with pytest.raises(ValueError, match=r"other settings: loss\.alpha=0\.2, now 0\.5; seed=0, now 1\. Set them back"):
        train(other, finished, mesh=data_mesh(2))


def test_a_checkpoint_of_another_model_is_refused_and_stays_as_it_is(
    run_config: TrainConfig, pixel_params: Any, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Its parameters have other shapes too: it is the settings that are named, not the first array that does not fit.
    wider = {**pixel_params, "camera_head": {"kernel": np.zeros((5, 9), np.float32), "bias": np.zeros(9, np.float32)}}
    monkeypatch.setattr(loop, "abstract_parameters", lambda _: jax.eval_shape(lambda: wider))
    monkeypatch.setattr(loop, "make_program", make_program)
    model = dataclasses.replace(
        run_config.model,
        aggregator=dataclasses.replace(run_config.model.aggregator, depth=6, key_layers=(0, 1, 2, 5)),
        encoder=dataclasses.replace(run_config.model.encoder, embed_dim=64),
    )
    before = _contents(finished)
    assert {name.parts[0] for name in before} >= {"checkpoints", "model", "metrics.jsonl"}
    with pytest.raises(InputError) as refused:
        train(dataclasses.replace(run_config, model=model), finished, mesh=data_mesh(2))
    message = str(refused.value)
    assert message.startswith(f"checkpoint of step 6 in {finished}") and "\n" not in message
    assert (
        "other settings: model.aggregator.depth=4, now 6; model.aggregator.key_layers[3]=3, now 5; "
        "model.encoder.embed_dim=32, now 64. Set them back" in message
    )
    assert _contents(finished) == before


def _contents(folder: Path) -> dict[Path, bytes]:
    """All files of a folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder): path.read_bytes() for path in files}


def test_a_run_does_not_go_on_with_sequences_that_grew(
    run_config: TrainConfig, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {**dict(run_config.data.sources[0].options), "num_frames": 10}
    monkeypatch.setattr(loop, "open_data", lambda _: ({"rooms": open_dataset("rooms", None, "train", **options)}, ()))
    # Where the next stage, which begins anew, has no position of its own to compare.
    with pytest.raises(InputError, match=r"rooms, room-00000 had frames 0:8 and has 0:10 now; .* and 3 more"):
        train(run_config, finished, mesh=data_mesh(2), resume_step=4)


def test_resume_step_that_does_not_exist_is_refused(run_config: TrainConfig, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no checkpoint of step 5; there are none"):
        train(run_config, tmp_path, mesh=data_mesh(2), resume_step=5)


def test_endless_non_finite_updates_stop_the_run(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pixel_params: Any
) -> None:
    broken = {**pixel_params, "depth_head": jax.tree.map(lambda x: x * np.nan, pixel_params["depth_head"])}
    monkeypatch.setattr(loop, "initial_parameters", lambda *_, **__: jax.tree.map(jnp.array, broken))
    with pytest.raises(NonFiniteTraining, match="step 2: 2 updates in a row had a non-finite loss or gradient"):
        train(run_config, tmp_path, mesh=data_mesh(2))


def test_a_work_folder_that_is_a_file_is_refused_before_data_are_read(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "open_data", lambda _: pytest.fail("not yet"))
    (tmp_path / "run").write_text("notes")
    with pytest.raises(InputError, match=r"run is no folder; choose another output"):
        train(run_config, tmp_path / "run", mesh=data_mesh(2))


def test_data_that_fail_leave_a_checkpoint(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = BatchIterator.__next__

    def fail(batches: BatchIterator) -> Any:
        if batches.get_state()["examples"] == 2 * run_config.stages[0].batch_size:
            raise InputError("the disk is gone")
        return draw(batches)

    monkeypatch.setattr(BatchIterator, "__next__", fail)
    with pytest.raises(InputError, match="the disk is gone"):
        train(run_config, tmp_path, mesh=data_mesh(2))
    assert RunCheckpoints(tmp_path, run_config).steps[-1] == 2


@pytest.mark.usefixtures("forked_workers")
def test_a_reading_process_that_is_killed_leaves_a_checkpoint(
    run_config: TrainConfig, straight: tuple[TrainState, Path], tmp_path: Path
) -> None:
    def kill_readers() -> None:
        # When it has filled its queue and waits: with one of Grain's locks in its hands it would take that along, which
        # the main process then waits for until the watchdog ends it.
        time.sleep(0.3)
        for child in multiprocessing.active_children():
            if "grain" in child.name and child.pid is not None:
                os.kill(child.pid, signal.SIGKILL)

    workers = dataclasses.replace(run_config, data=dataclasses.replace(run_config.data, worker_count=1))
    error = r"reading workers were killed 1 times .*exit code -9"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError, match=error):
        patch.setattr("logvggt_jax.data.feeding.batches._MOST_RESTARTS", 0)
        _at_step(patch, 1, kill_readers)
        train(workers, tmp_path, mesh=data_mesh(2))
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        last = checkpoints.steps[-1]
    # A few clips had been read by then.
    assert 1 <= last < run_config.stages[0].steps
    assert [entry["step"] for entry in _numbers(tmp_path)] == [*range(1, last + 1)]
    _same(train(run_config, tmp_path, mesh=data_mesh(2)), straight[0])
    assert _numbers(tmp_path) == _numbers(straight[1])


def test_a_line_shows_the_mean_of_its_interval(
    run_config: TrainConfig, straight: tuple[TrainState, Path], tmp_path: Path
) -> None:
    train(dataclasses.replace(run_config, log_every=50), tmp_path, mesh=data_mesh(2))
    each = {entry["step"]: entry for entry in _numbers(straight[1])}
    lines = _numbers(tmp_path)
    # The first step, saves, and the ends of the stages.
    assert [line["step"] for line in lines] == [1, 3, 4, 6]
    for name in ("loss/total", "train/abs_rel", "gradient_norm/depth_head"):
        assert lines[1][name] == pytest.approx((each[2][name] + each[3][name]) / 2)
    assert lines[1]["learning_rate"] == each[3]["learning_rate"]


def test_operations_of_a_size_are_counted_behind_its_first_step(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each takes seconds to count: a start waits for none of them."""
    events: list[Any] = []

    class Batches(DeviceBatches):
        def __next__(self) -> Any:
            batch = super().__next__()
            events.append(batch["images"].shape[:4])
            return batch

    def count(model: Any, clips: tuple[int, ...], *, frozen: tuple[str, ...]) -> float:
        assert (model, frozen) == (run_config.model, frozen_patterns(run_config))
        events.append(("counted", clips))
        return 1e6

    monkeypatch.setattr(loop, "DeviceBatches", Batches)
    monkeypatch.setattr(loop, "step_flops", count)
    monkeypatch.setattr(loop, "_peak", lambda mesh, dtype: 1e6)
    train(run_config, tmp_path, mesh=data_mesh(1))
    first, second = (2, 2, 28, 42), (2, 3, 28, 42)
    assert events == [first, ("counted", first), first, first, first, second, ("counted", second), second]
    assert all(line["utilisation"] > 0 for line in read_metrics(tmp_path / "metrics.jsonl") if "loss" in line)


def test_goodput_counts_earlier_sessions(
    run_config: TrainConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(dataclasses.replace(run_config, max_minutes=1e-9), tmp_path, mesh=data_mesh(2))
    first = read_metrics(tmp_path / "times.jsonl")
    train(run_config, tmp_path, mesh=data_mesh(2))
    entries = read_metrics(tmp_path / "times.jsonl")
    assert entries[: len(first)] == first and [entry["step"] for entry in first] == [0, 1]
    productive = [entry["productive_seconds"] for entry in entries]
    assert productive == sorted(productive) and productive[0] == 0 < productive[1] < productive[-1]
    assert 0 <= entries[1]["data_share"] <= 1 and entries[-1]["run_seconds_left"] == 0
    assert re.search(r"goodput \d+%: \S+ of training in \S+ since the first start", capsys.readouterr().out)


def test_a_trace_of_some_steps_is_written(run_config: TrainConfig, tmp_path: Path) -> None:
    train(run_config, tmp_path, mesh=data_mesh(2), profile=ProfiledSteps.parse("3:4"))
    (trace,) = (tmp_path / "profile").rglob("*.xplane.pb")
    profile = jax.profiler.ProfileData.from_file(str(trace))
    names = [event.name for plane in profile.planes for line in plane.lines for event in line.events]
    # On the host two steps and no third: the tracer names a function by its file and line.
    assert len([name for name in names if re.fullmatch(r"\$steps_in_flight\.py:\d+ add", name)]) == 2
    # On each device two runs of the step's program.
    runs = Counter(name.split()[0] for name in names if re.fullmatch(r"\[\d+\] .* \(jit_on_all_devices\)", name))
    assert runs == {"[0]": 2, "[1]": 2}
    with pytest.raises(InputError, match=r"--profile=4:3: expected the first and the last step, such as 20:25"):
        ProfiledSteps.parse("4:3")


@pytest.mark.parametrize("failing", ["start_trace", "stop_trace"])
def test_a_trace_that_cannot_be_written_ends_no_run(
    run_config: TrainConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    failing: str,
) -> None:
    stop = jax.profiler.stop_trace

    def full(*_: object) -> None:
        # What has begun is ended here: every later call of a function would be noted as well.
        if failing == "stop_trace":
            stop()
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: profile/vm.xplane.pb; No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(jax.profiler, failing, full)
        train(run_config, tmp_path, mesh=data_mesh(2), profile=ProfiledSteps.parse("3:4"))
    assert "No space left on device" in caplog.text
    assert read_metrics(tmp_path / "metrics.jsonl")[-1]["step"] == run_config.total_steps


def test_the_data_are_looked_for_before_the_weights_are_read(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "initial_parameters", lambda *_, **__: pytest.fail("the weights were read"))
    source = SourceConfig(name="scannet", root=str(tmp_path / "none"), split="train")
    data = dataclasses.replace(run_config.data, sources=(source,))
    with pytest.raises(InputError, match="scannet"):
        train(dataclasses.replace(run_config, data=data), tmp_path / "run", mesh=data_mesh(2))


def test_the_model_names_the_data_that_it_was_trained_on_and_none_that_were_missing(
    run_config: TrainConfig, tmp_path: Path
) -> None:
    absent = SourceConfig(name="scannet", root=str(tmp_path / "none"), split="train")
    data = dataclasses.replace(run_config.data, sources=(*run_config.data.sources, absent), allow_missing=True)
    config = dataclasses.replace(run_config, data=data, max_minutes=1e-9)
    train(config, tmp_path / "run", mesh=data_mesh(2))
    training = read_provenance(tmp_path / "run" / "model").training
    assert training is not None and training.data == "rooms (train)"


def test_the_watchdog_sleeps_while_the_data_are_opened(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A teacher labels for hours before the first step."""

    def opened(config: TrainConfig) -> None:
        del config
        threads = {thread.name for thread in threading.enumerate()}
        raise InputError(f"watched: {'watchdog' in threads}")

    monkeypatch.setattr(loop, "open_data", opened)
    with pytest.raises(InputError, match="watched: False"):
        train(run_config, tmp_path, mesh=data_mesh(2), watchdog=30.0)


@pytest.mark.parametrize("reason", ["RESOURCE_EXHAUSTED: Out of memory while trying to allocate", "INTERNAL: broken"])
def test_a_step_that_does_not_fit_says_what_it_needs_and_what_lowers_it(
    reason: str, run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = loop.compiled_steps

    def refuse(*_: object) -> None:
        raise jax.errors.JaxRuntimeError(reason)

    class Refusing:
        def __init__(self, step: jax.stages.Compiled) -> None:
            self.memory_analysis = step.memory_analysis

        __call__ = staticmethod(refuse)

    monkeypatch.setattr(
        loop,
        "compiled_steps",
        lambda *given, **named: [step._replace(run=Refusing(step.run)) for step in compiled(*given, **named)],
    )
    monkeypatch.setattr("logvggt_jax.training.step.device_memory.device_bytes", lambda device: 3 * 2**30)
    if reason.startswith("INTERNAL"):
        with pytest.raises(jax.errors.JaxRuntimeError, match="broken"):
            train(run_config, tmp_path, mesh=data_mesh(2))
        return
    stage = run_config.stages[0]
    message = (
        rf"stage '{stage.name}' does not fit the memory of cpu, 3\.0 GiB, where the largest step needs [\d.]+ GiB: "
        rf"lower stages\.{stage.name}\.batch_size={stage.batch_size} \({stage.batch_size // 2} clips a device\)"
        rf" or clip_length={stage.clip_length}, .*--dry_run"
    )
    with pytest.raises(InputError, match=message):
        train(run_config, tmp_path, mesh=data_mesh(2))


@pytest.mark.parametrize("at", [0, 3])
def test_a_validation_that_does_not_fit_names_what_lowers_it(
    at: int, run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged, steps = loop.Validation.__call__, iter((0, 3))

    def full(*given: Any) -> Judgement:
        if next(steps) == at:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate")
        return judged(*given)

    monkeypatch.setattr(loop.Validation, "__call__", full)
    message = (
        r"^validation does not fit the memory of cpu, which takes one clip at a time: lower "
        r"validation\.size=\(28, 42\) or validation\.clip_length=3 \(RESOURCE_EXHAUSTED"
    )
    with pytest.raises(InputError, match=message):
        train(_validated(run_config), tmp_path, mesh=data_mesh(2))


def test_validation_reports_held_out_clips(run_config: TrainConfig, tmp_path: Path) -> None:
    source = SourceConfig(name="rooms", root=None, split="val", options=run_config.data.sources[0].options)
    validation = ValidationConfig(sources=(source,), every=4, num_clips=4, clip_length=3, stride=2, size=(28, 42))
    train(dataclasses.replace(run_config, validation=validation), tmp_path, mesh=data_mesh(2))
    entries = [entry for entry in _numbers(tmp_path) if "validation/abs_rel" in entry]
    # Once before the first step: what cannot be judged says so at once.
    assert [entry["step"] for entry in entries] == [0, 4, 6]
    for entry in entries:
        assert 0 < entry["validation/abs_rel"] < 2
        assert entry["validation/rotation_over_identity"] == pytest.approx(
            entry["validation/rotation"] / entry["validation/identity_rotation"]
        )
    # The time left is foretold from what a validation takes once its program is there.
    spent = read_metrics(tmp_path / TIMES_NAME)[-1]
    assert {f"{COST}compilation of validation", f"{COST}validation"} <= set(spent)


def _judge(patch: pytest.MonkeyPatch, *found: float, metric: str = "abs_rel") -> None:
    """Validations find these values of a metric, one after the other, and 0 of all else."""
    values = {f"validation/{name}": 0.0 for name in (*VALIDATION_METRICS, "constant_abs_rel", "identity_rotation")}
    judged = iter(found)

    class Judge:
        compiled = True

        def __init__(self, *_: Any) -> None:
            pass

        def __call__(self, _: Any) -> Judgement:
            return Judgement({**values, f"validation/{metric}": next(judged)}, {})

    patch.setattr(loop, "Validation", Judge)


def _validated(config: TrainConfig, *, best: str | None = None) -> TrainConfig:
    source = SourceConfig(name="rooms", root=None, split="val", options=config.data.sources[0].options)
    validation = ValidationConfig(
        sources=(source,), every=3, num_clips=2, clip_length=3, stride=2, size=(28, 42), best=best
    )
    return dataclasses.replace(config, validation=validation)


@pytest.mark.parametrize(
    ("metric", "found", "kept"),
    # After no step, three and six: errors are to be small and shares large, a tie or what is no number is no gain.
    [("abs_rel", (0.5, 0.2, 0.2), 3), ("delta_1.25", (0.2, float("nan"), 0.3), 6), ("auc_30", (0.5, 0.4, 0.5), 0)],
)
def test_the_best_model_by_the_named_metric_is_kept(
    metric: str, found: tuple[float, ...], kept: int, run_config: TrainConfig, tmp_path: Path
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        _judge(patch, *found, metric=metric)
        train(_validated(run_config, best=metric), tmp_path, mesh=data_mesh(2))
    training = read_provenance(tmp_path / "best").training
    assert training is not None and training.steps == kept
    last = read_provenance(tmp_path / "model").training
    assert last is not None and last.steps == 6


def test_the_best_model_is_compared_with_the_one_that_is_kept() -> None:
    lines = [{"step": 0, "validation/abs_rel": 0.2}, {"step": 3, "validation/abs_rel": 0.4}]
    name = "validation/abs_rel"
    judged = {
        held: [
            is_best(lines, 6, "abs_rel", {name: value}, held=held, digest="any")
            for value in (0.1, 0.3, 0.5, float("nan"))
        ]
        for held in (None, 0, 3, 9)
    }
    assert judged == {
        None: [True, True, True, False],  # of the model of step 0 nothing is left
        0: [True, False, False, False],
        3: [True, True, False, False],
        9: [True, False, False, False],
    }


def test_the_best_model_is_compared_on_the_same_clips_alone(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _judge(monkeypatch, 0.1, 0.2, 0.5, 0.4, 0.6)

    def kept(config: TrainConfig) -> int | None:
        train(config, tmp_path, mesh=data_mesh(2))
        training = read_provenance(tmp_path / "best").training
        return None if training is None else training.steps

    first, last = run_config.stages
    easy = _validated(_at_constant_rate(run_config, first, last), best="abs_rel")
    assert easy.validation is not None
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _at_step(patch, 4, _crash)
        train(easy, tmp_path, mesh=data_mesh(2))
    # Of other clips 0.5 is the first that is known; how often they are judged does not make them others.
    hard = dataclasses.replace(easy, validation=dataclasses.replace(easy.validation, stride=1))
    assert kept(hard) == 6
    often = dataclasses.replace(easy, validation=dataclasses.replace(easy.validation, stride=1, every=100))
    assert kept(dataclasses.replace(often, stages=(first, dataclasses.replace(last, steps=3)))) == 7
    assert kept(dataclasses.replace(often, stages=(first, dataclasses.replace(last, steps=4)))) == 7
    lines = [line for line in _numbers(tmp_path) if "validation/abs_rel" in line]
    assert [line["step"] for line in lines] == [0, 3, 6, 7, 8]
    sets = [line["validation_set"] for line in lines]
    assert sets[0] == sets[1] != sets[2] == sets[3] == sets[4]


def test_a_run_that_is_killed_between_its_best_model_and_the_line_about_it_shows_both(
    run_config: TrainConfig, tmp_path: Path
) -> None:
    shown: list[int] = []

    def show(_: MetricsLog, step: int, pictures: dict[str, np.ndarray]) -> None:
        shown.append(step)
        assert set(pictures) == {"validation/rooms/clip", "validation/rooms/trajectory"}
        if shown == [0, 3]:
            _crash()

    config = _validated(run_config, best="abs_rel")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        patch.setattr(MetricsLog, "show", show)
        train(config, tmp_path, mesh=data_mesh(2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MetricsLog, "show", show)
        train(config, tmp_path, mesh=data_mesh(2))
    assert shown == [0, 3, 3, 6]
    lines = [entry for entry in _numbers(tmp_path) if "validation/abs_rel" in entry]
    errors = {entry["step"]: entry["validation/abs_rel"] for entry in lines}
    assert list(errors) == [0, 3, 6]
    training = read_provenance(tmp_path / "best").training
    assert training is not None and training.steps == min(errors, key=lambda step: errors[step])


def test_a_best_model_that_a_kill_kept_from_the_disk_is_made_up_for(run_config: TrainConfig, tmp_path: Path) -> None:
    config = _validated(run_config, best="abs_rel")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _judge(patch, 0.5, 0.2)
        keep = RunCheckpoints.save_best
        patch.setattr(
            RunCheckpoints, "save_best", lambda self, state: keep(self, state) if int(state.step) == 0 else None
        )
        _at_step(patch, 4, _crash)
        train(config, tmp_path, mesh=data_mesh(2))
    assert RunCheckpoints(tmp_path, config).best_step == 0
    with pytest.MonkeyPatch.context() as patch:
        _judge(patch, 0.3)  # what was validated is not validated again
        train(config, tmp_path, mesh=data_mesh(2))
    assert RunCheckpoints(tmp_path, config).best_step == 3


def test_a_folder_in_use_is_refused_before_any_data_are_looked_at(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "open_data", lambda _: pytest.fail("the data were opened"))
    with RunCheckpoints(tmp_path, run_config), pytest.raises(InputError, match="another run is using this folder"):
        train(run_config, tmp_path, mesh=data_mesh(2))


def test_a_validation_that_fails_has_its_checkpoint_and_is_made_up_for(
    run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _validated(run_config)
    train(config, tmp_path / "straight", mesh=data_mesh(2))
    judged = loop.Validation.__call__

    def fail(*given: Any) -> Any:
        if int(RunCheckpoints(tmp_path / "run", config).steps[-1]) == 3:
            raise RuntimeError("out of memory")
        return judged(*given)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="out of memory"):
        patch.setattr(loop.RunCheckpoints, "save", _saved_at_once(loop.RunCheckpoints.save))
        patch.setattr(loop.Validation, "__call__", fail)
        train(config, tmp_path / "run", mesh=data_mesh(2))
    with RunCheckpoints(tmp_path / "run", config) as checkpoints:
        assert checkpoints.steps == [0, 3]
    train(config, tmp_path / "run", mesh=data_mesh(2))
    assert _numbers(tmp_path / "run") == _numbers(tmp_path / "straight")


def _saved_at_once(save: Callable[..., None]) -> Callable[..., None]:
    def saved(checkpoints: RunCheckpoints, *given: Any, **options: Any) -> None:
        save(checkpoints, *given, **options)
        checkpoints.wait()

    return saved


@pytest.mark.parametrize("failing", ["save", "validation"])
def test_a_save_or_a_validation_that_fails_says_so_before_the_first_step(
    failing: str, run_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise OSError("cannot be done")

    if failing == "save":
        monkeypatch.setattr("logvggt_jax.training.checkpoints.run_checkpoints.write_checkpoint", fail)
    else:
        monkeypatch.setattr(loop.Validation, "__call__", fail)
    monkeypatch.setattr(loop._Run, "_compile", lambda *_: pytest.fail("no step is to be compiled"))
    with pytest.raises(OSError, match="cannot be done"):
        train(_validated(run_config), tmp_path, mesh=data_mesh(2))


def test_settings_may_change_until_a_step_is_done(run_config: TrainConfig, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        patch.setattr(loop._Run, "_compile", lambda *_: _crash())
        train(run_config, tmp_path, mesh=data_mesh(2))
    other = dataclasses.replace(run_config, loss=dataclasses.replace(run_config.loss, alpha=0.5))
    assert int(train(other, tmp_path, mesh=data_mesh(2)).step) == 6


@pytest.mark.parametrize("best", [0, 3])
def test_a_run_that_begins_anew_keeps_no_validation_of_the_start_before(
    best: int, run_config: TrainConfig, tmp_path: Path
) -> None:
    config = dataclasses.replace(_validated(run_config, best="abs_rel"), save_every=100)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _judge(patch, 0.2, 0.1 if best else 0.3)
        _at_step(patch, 4, _crash)
        train(config, tmp_path, mesh=data_mesh(2))
    kept = read_provenance(tmp_path / "best").training
    assert kept is not None and kept.steps == best
    other = dataclasses.replace(_validated(run_config), loss=dataclasses.replace(run_config.loss, alpha=0.5))
    with pytest.MonkeyPatch.context() as patch:
        _judge(patch, 0.9, 0.8, 0.7)
        train(other, tmp_path, mesh=data_mesh(2))
    errors = [entry["validation/abs_rel"] for entry in _numbers(tmp_path) if "validation/abs_rel" in entry]
    assert errors == [0.9, 0.8, 0.7]
    # What had learned something is not thrown away.
    assert [path.name for path in tmp_path.glob("best*")] == (["best.aside"] if best else [])


def test_a_run_goes_on_when_its_initial_weights_are_gone(
    run_config: TrainConfig, straight: tuple[TrainState, Path], finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "initial_parameters", lambda *_, **__: pytest.fail("a run that goes on has its own"))
    config = dataclasses.replace(run_config, initial_weights="gone")
    _same(train(config, finished, mesh=data_mesh(2), resume_step=4), straight[0])
    monkeypatch.setattr(loop, "open_data", lambda _: pytest.fail("before data are drawn"))
    with pytest.raises(FileNotFoundError, match="gone: no such file or folder"):
        train(config, finished / "new", mesh=data_mesh(2))


@pytest.mark.slow
@pytest.mark.usefixtures("real_model")
def test_real_model_trains_and_leaves_a_model_folder(run_config: TrainConfig, tmp_path: Path) -> None:
    state = train(run_config, tmp_path, mesh=data_mesh(1))
    model, variables = load_model(tmp_path / "model")
    assert model.config == run_config.model
    provenance = read_provenance(tmp_path / "model")
    assert provenance.trained_for == "windows" and provenance.longer_edge == 42
    jax.tree.map(np.testing.assert_array_equal, stack_layers(variables["params"]), jax.device_get(state.params))
    losses = [entry["loss/total"] for entry in _numbers(tmp_path)]
    assert losses[-1] < losses[0]


def test_workers_may_change_when_a_run_goes_on(
    run_config: TrainConfig, straight: tuple[TrainState, Path], finished: Path
) -> None:
    threads = dataclasses.replace(run_config, data=dataclasses.replace(run_config.data, num_threads=2, max_broken=0.1))
    _same(train(threads, finished, mesh=data_mesh(2), resume_step=4), straight[0])
    assert all(entry["broken_clips"] == 0 for entry in _numbers(finished))
    backwards = dataclasses.replace(run_config, data=dataclasses.replace(run_config.data, reverse=1.0))
    with pytest.raises(ValueError, match=r"other settings: data\.reverse=0\.5, now 1\.0"):
        train(backwards, finished, mesh=data_mesh(2))


def test_clips_that_make_updates_useless_are_named_and_the_same_command_goes_past_them(
    run_config: TrainConfig,
    pixel_model: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(loop, "LogVGGT", lambda _: DazzledModel(pixel_model.config, pixel_model))
    # The loss of both clips of the second batch, the gradient of one of the third: the steps 2 and 3 of four.
    read, colours = ClipReader.__call__, {2: 0, 3: 0, 4: 255}

    def reading(reader: ClipReader, index: int, sequence: str) -> dict[str, Any]:
        clip = read(reader, index, sequence)
        if reader.sampler.length == 2 and index in colours:
            clip["images"] = np.full_like(clip["images"], colours[index])
        return clip

    monkeypatch.setattr(ClipReader, "__call__", reading)
    with pytest.raises(NonFiniteTraining, match=r"step 3: 2 updates in a row .* with rooms, .*goes on past") as end:
        train(run_config, tmp_path, mesh=data_mesh(2))
    named = [line for line in caplog.messages if "update left out" in line]
    assert [line.split(" was not finite in ")[0] for line in named] == [
        "step 2: update left out, loss",
        "step 3: update left out, loss or gradient",
    ]
    assert [line.count("rooms, ") for line in named] == [2, 1]
    assert str(end.value).count("rooms, ") == 3 and "frames" in str(end.value)
    # What the run before had learned is there, and so is the good checkpoint.
    with RunCheckpoints(tmp_path, run_config) as checkpoints:
        assert checkpoints.steps == [0, 3]
    state = train(run_config, tmp_path, mesh=data_mesh(2))
    assert int(state.step) == 6 and int(state.skipped) == 2
    assert [entry["step"] for entry in _numbers(tmp_path)] == [1, 2, 3, 4, 5, 6]


def test_updates_left_out_before_a_start_do_not_end_it(
    run_config: TrainConfig, pixel_model: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "LogVGGT", lambda _: DazzledModel(pixel_model.config, pixel_model))
    read = ClipReader.__call__

    # Those of the second step, in the first stage alone.
    def reading(reader: ClipReader, index: int, sequence: str) -> dict[str, Any]:
        clip = read(reader, index, sequence)
        return (
            {**clip, "images": np.zeros_like(clip["images"])} if index in (2, 3) and len(clip["images"]) == 2 else clip
        )

    monkeypatch.setattr(ClipReader, "__call__", reading)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _at_step(patch, 5, _crash)
        train(run_config, tmp_path, mesh=data_mesh(2))
    state = train(dataclasses.replace(run_config, max_skipped_in_a_row=1), tmp_path, mesh=data_mesh(2))
    assert int(state.skipped) == 1 and int(state.step) == run_config.total_steps


def test_useless_restarts_do_not_push_good_checkpoints_out(
    run_config: TrainConfig, pixel_model: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = dataclasses.replace(run_config, max_skipped_in_a_row=1)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyError, match="crash"):
        _at_step(patch, 4, _crash)
        train(config, tmp_path, mesh=data_mesh(2))
    monkeypatch.setattr(loop, "LogVGGT", lambda _: DazzledModel(pixel_model.config, pixel_model))
    read = ClipReader.__call__
    monkeypatch.setattr(
        ClipReader,
        "__call__",
        lambda reader, *given: {**(clip := read(reader, *given)), "images": np.zeros_like(clip["images"])},
    )
    for step in (4, 5, 6):
        with pytest.raises(NonFiniteTraining, match=f"step {step}: 1 updates in a row"):
            train(config, tmp_path, mesh=data_mesh(2))
        with RunCheckpoints(tmp_path, config) as checkpoints:
            # Of the same parameters one is kept, the newest.
            assert checkpoints.steps == [0, step]


def test_a_save_that_is_under_way_when_updates_fail_gives_place_to_the_next(
    run_config: TrainConfig, pixel_model: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "LogVGGT", lambda _: DazzledModel(pixel_model.config, pixel_model))
    read, write = ClipReader.__call__, run_checkpoints.write_checkpoint

    def reading(reader: ClipReader, index: int, sequence: str) -> dict[str, Any]:
        clip = read(reader, index, sequence)
        # Those of the fourth step, one after a save.
        return {**clip, "images": np.zeros_like(clip["images"])} if index in (6, 7) else clip

    def slow(folder: Path, *given: Any) -> None:
        time.sleep(1 if folder.name == "3" else 0)
        write(folder, *given)

    monkeypatch.setattr(ClipReader, "__call__", reading)
    monkeypatch.setattr(run_checkpoints, "write_checkpoint", slow)
    config = dataclasses.replace(run_config, max_skipped_in_a_row=1)
    with pytest.raises(NonFiniteTraining, match="step 4: 1 updates in a row"):
        train(config, tmp_path, mesh=data_mesh(2))
    # The step that was left out changed nothing of what was saved after the third.
    assert RunCheckpoints(tmp_path, config).steps == [0, 4]
