"""Two processes that train together give one process's numbers and leave one set of files."""

import contextlib
import platform
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from pixel_program import READERS_KILLED, PixelRuns, free_port
from root_programs import RootPrograms

from logvggt_jax.errors import InputError
from logvggt_jax.training.checkpoints.checkpoint_files import StoredCheckpoint
from logvggt_jax.training.parallel import agreement
from logvggt_jax.training.parallel.agreement import any_process, check_agreement
from logvggt_jax.training.parallel.joining import check_processes, join_processes
from logvggt_jax.training.parallel.lifeline import SILENCE_SECONDS
from logvggt_jax.training.parallel.same_settings import check_same_parameters
from logvggt_jax.training.reporting.metrics_log import read_metrics
from logvggt_jax.weights.checkpoints import load_model

ROOT = Path(__file__).parents[3]
# One shape of clip and few steps: nearly all of the time is compilation.
SETTINGS = (
    "--config=configs/tiny.py",
    "--config.stages.stage_1.steps=3",
    "--config.stages.stage_2.steps=1",
    "--config.stages.stage_2.clip_length=4",
    "--config.stages.stage_2.batch_size=8",
    "--config.data.sources.rooms.options.num_rooms=8",
    "--config.data.sources.rooms.options.num_frames=24",
    "--config.validation.num_clips=4",
    "--config.validation.sources.rooms.options.num_rooms=4",
    "--config.validation.every=2",
    "--config.log_every=1",
    "--config.save_every=2",
)


def started(workdir: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "train.py", *SETTINGS, f"--workdir={workdir}", *arguments]
    return subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def test_one_process_alone_answers_for_itself() -> None:
    assert jax.process_count() == 1 and any_process(True) and not any_process(False)
    check_agreement("anything", {"a": 1})


def test_processes_that_differ_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    monkeypatch.setattr(
        agreement.multihost_utils, "process_allgather", lambda digest: np.stack([digest, digest + 1, digest])
    )
    with pytest.raises(ValueError, match=r"the data of the processes \[1\] differ from those of process 0"):
        check_agreement("the data", {"a": 1})


@pytest.mark.parametrize(("gpus", "warned"), [(8, True), (1, False)])
def test_several_gpus_of_one_process_draw_a_warning(
    gpus: int, warned: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_device_count", lambda: gpus)
    check_processes()
    assert warned == ("owns 8 GPUs beside 1 other processes" in caplog.text)


def test_half_an_address_is_refused() -> None:
    with pytest.raises(ValueError, match="all of --coordinator, --num_processes and --process_id"):
        join_processes(coordinator="localhost:1234")
    with pytest.raises(InputError, match="--coordinator=localhost: expected HOST:PORT"):
        join_processes(coordinator="localhost", num_processes=2, process_id=1)


@pytest.mark.parametrize("lost", [1, pytest.param(0, marks=pytest.mark.slow)])
def test_the_loss_of_a_process_ends_the_other_with_one_line(lost: int, programs: RootPrograms, tmp_path: Path) -> None:
    with PixelRuns(programs, tmp_path, tmp_path) as runs:
        runs.training()
        started = time.monotonic()
        runs.processes[lost].send_signal(signal.SIGKILL)
        errors = runs.errors(1 - lost)
        assert time.monotonic() - started < 10
        assert runs.processes[1 - lost].returncode == 1, errors
        where = f"process {lost} on {re.escape(platform.node())}"
        line = rf"train.py: {where} was lost: it was killed, or its machine is gone\n"
        assert re.fullmatch(line, errors), errors


@pytest.mark.slow
def test_a_stopped_process_ends_the_other_with_one_line(programs: RootPrograms, tmp_path: Path) -> None:
    """Its machine still answers for it, and JAX would end the other with a trace that names none."""
    with PixelRuns(programs, tmp_path, tmp_path) as runs:
        runs.training()
        started = time.monotonic()
        runs.processes[1].send_signal(signal.SIGSTOP)
        errors = runs.errors(0)
        assert time.monotonic() - started < SILENCE_SECONDS + 5
        assert runs.processes[0].returncode == 1, errors
        silent = f"for {SILENCE_SECONDS} s it has said nothing, stopped or on a machine that is gone"
        assert errors == f"train.py: process 1 on {platform.node()} was lost: {silent}\n"


@pytest.mark.parametrize(
    ("error", "told"),
    [
        ("KeyError('a bug')", "KeyError: 'a bug'"),
        # It may be the consequence of a loss elsewhere, for whose line it waits first.
        ("jax.errors.JaxRuntimeError('INTERNAL: a bug')", "JaxRuntimeError: INTERNAL: a bug"),
    ],
)
def test_any_exception_ends_its_process_with_a_traceback_and_the_other_with_a_line(
    error: str, told: str, programs: RootPrograms, tmp_path: Path
) -> None:
    patch = f"""
import time, jax
def fail(*_):
    print(time.monotonic(), flush=True)
    raise {error}
loop._Run._validate = fail
"""
    with PixelRuns(programs, tmp_path, tmp_path, patches=("", patch), flags=("--config.validation.every=10",)) as runs:
        assert "Traceback" in runs.errors(1) and runs.processes[1].returncode == 1
        errors = runs.errors(0)
        assert time.monotonic() - float(runs.processes[1].output.read_text().split()[-1]) < 10
        assert runs.processes[0].returncode == 1
        assert re.fullmatch(rf"train.py: process 1 on \S+ was lost, it ended with: {told}\n", errors), errors


def test_a_stop_signal_for_one_process_stops_all_after_the_same_step(programs: RootPrograms, tmp_path: Path) -> None:
    # Just after its vote of step 10: no signal waits longer.
    patch = """
import os, signal
write = loop.MetricsLog.write
def stop(log, step, *given, **words):
    write(log, step, *given, **words)
    if step == 10:
        os.kill(os.getpid(), signal.SIGTERM)
loop.MetricsLog.write = stop
"""
    with PixelRuns(programs, tmp_path, tmp_path, patches=("", patch)) as runs:
        codes = [process.wait() for process in runs.processes]
        output = runs.processes[0].output.read_text()
        assert codes == [0, 0], output + runs.errors(0)
        found = re.search(r"stopping after step (\d+): another process is to stop", output)
        assert found is not None, output
        # As docs/clusters.md promises: three later at most.
        assert int(found[1]) == 10 + 3
        assert (tmp_path / "checkpoints" / found[1]).is_dir()
        assert re.search(r"step 10/.*waiting for data \d+% \(process [01]\)", output), output


@pytest.mark.parametrize("batches", [12, 1])
def test_all_save_where_the_clips_of_one_process_end(batches: int, programs: RootPrograms, tmp_path: Path) -> None:
    # A run that could not save after one of its first three steps makes none of them.
    steps = batches if batches >= 3 else 0
    patches = ("", READERS_KILLED.format(2 * batches))
    with PixelRuns(programs, tmp_path, tmp_path, patches=patches, flags=("--validation_source=none",)) as runs:
        errors = [runs.errors(number) for number in range(2)]
        assert [process.returncode for process in runs.processes] == [1, 1], errors
        output = runs.processes[0].output.read_text()
    error = "reading workers were killed"
    where = re.escape(platform.node())
    assert re.fullmatch(rf"process \d+ on {where}: train\.py: {error}\n", errors[1]), errors[1]
    assert errors[0] == f"train.py: process 1 on {platform.node()} was lost, it ended with: InputError: {error}\n"
    assert (f"stopping after step {steps}: another process is to stop" in output) == (steps > 0), output
    assert max((entry["step"] for entry in read_metrics(tmp_path / "metrics.jsonl")), default=0) == steps
    saved = StoredCheckpoint(tmp_path / "checkpoints" / str(steps))
    assert saved.step == steps and saved.position.data["examples"] == 2 * steps
    assert saved.position.data["broken"]["clips"] == 2 * steps, "of both processes"


def test_clips_of_one_process_that_make_an_update_useless_are_named_by_all(
    programs: RootPrograms, tmp_path: Path
) -> None:
    dazzled = """
from dazzled_model import DazzledModel
loop.LogVGGT = lambda config: DazzledModel(config, conftest.PixelModel(config))
"""
    # The loss of every other clip, the gradient of those between them.
    black_and_white = """
from logvggt_jax.data.feeding.clips import ClipReader
read = ClipReader.__call__
def reading(reader, index, *given):
    clip = read(reader, index, *given)
    colour, value = (("black", 0), ("white", 255))[index // 2 % 2]
    return {**clip, "images": 0 * clip["images"] + value, "name": f"{colour} {clip['name']}"}
ClipReader.__call__ = reading
"""
    flags = ("--config.max_skipped_in_a_row=2", "--config.log_every=100000", "--validation_source=none")
    with PixelRuns(programs, tmp_path, tmp_path, patches=(dazzled, dazzled + black_and_white), flags=flags) as runs:
        errors = [runs.errors(number) for number in range(2)]
        assert [process.returncode for process in runs.processes] == [1, 1], errors
    for said in errors:
        named = re.findall(r"step (\d): update left out, (.*) was not finite in (.*)", said)
        # Two more were under way when two were known.
        assert [found[:2] for found in named] == [
            (str(step), "loss" if step % 2 else "loss or gradient") for step in range(1, 5)
        ], said
        # Whoever ends second may also say what the first has ended with.
        (end,) = {
            *re.findall(r"4 updates in a row had a non-finite loss .*, with (.*); the same command goes on", said)
        }
        assert end == "; ".join(clips for *_, clips in named), said
        # One clip each, of process 1.
        assert all(
            re.fullmatch(rf"{'black' if what == 'loss' else 'white'} rooms, [^;]*", clips) for _, what, clips in named
        ), said


def test_processes_with_other_settings_are_refused(programs: RootPrograms, tmp_path: Path) -> None:
    # How clips are read may differ.
    own = (
        "--config.optimizer.learning_rate=5e-3",
        "--config.data.num_threads=3",
        "--profile=3:4",
        "--resume_step=0",
        "--config.data.sources.rooms.options.num_rooms=3",
    )
    with PixelRuns(programs, tmp_path, tmp_path, own=((), own)) as runs:
        errors = [runs.errors(number) for number in range(2)]
        assert [process.returncode for process in runs.processes] == [1, 1], errors
    said = (
        "process 1 was started with other settings than process 0: config.data.sources[0].options.num_rooms=3, there "
        "2; config.optimizer.learning_rate=0.005, there 0.001; profile=[3, 4], there None; resume_step=0, there None; "
        "start all with one command"
    )
    assert all(said in error and "Traceback" not in error for error in errors), errors
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("other", "refused"), [(0.0, False), (1e-6, True)])
def test_processes_with_other_initial_parameters_are_refused(
    other: float, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    params = {"a": np.arange(6, dtype=np.float32), "b": {"kernel": np.ones((2, 3), np.float32)}}
    sent = []

    def gathered(digest: np.ndarray) -> np.ndarray:
        sent.append(digest)
        return np.stack([digest, sent[0]])

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(agreement.multihost_utils, "process_allgather", gathered)
    check_same_parameters(params)
    params["b"]["kernel"][1, 1] += other
    with contextlib.ExitStack() as stack:
        if refused:
            told = r"the initial parameters of the processes \[1\] differ .*: give all the same file"
            stack.enter_context(pytest.raises(InputError, match=told))
        check_same_parameters(params)


def test_folders_that_are_not_shared_are_an_error_of_the_start(programs: RootPrograms, tmp_path: Path) -> None:
    patch = "from logvggt_jax.training.parallel import agreement; agreement.SHARED_SECONDS = 0.5"
    with PixelRuns(programs, tmp_path / "a", tmp_path / "b", patches=(patch, patch)) as runs:
        for number in range(2):
            errors = runs.errors(number)
            assert runs.processes[number].returncode == 1
            assert re.search(r"of the processes \[1\] is another folder than that of process 0", errors), errors
            assert "Traceback" not in errors
    assert not list((tmp_path / "a").iterdir())


def test_a_cache_of_labels_that_is_not_shared_is_an_error_before_anything_is_labelled(
    programs: RootPrograms, tmp_path: Path
) -> None:
    def patch(cache: Path) -> str:
        return f"""
import dataclasses
from logvggt_jax.training.config import TeacherConfig
from logvggt_jax.training.parallel import agreement
from logvggt_jax.training.teaching import run_data
from pixel_teacher import PixelTeacher
agreement.SHARED_SECONDS = 0.5
run_data.check_teacher = lambda _: None
run_data.PlainVGGT = lambda _: PixelTeacher()
def open_data(config):
    data = dataclasses.replace(config.data, cache_dir={str(cache)!r})
    loss = dataclasses.replace(config.loss, name="distillation")
    return run_data.open_data(dataclasses.replace(config, data=data, loss=loss, teacher=TeacherConfig("anything", 16)))
loop.open_data = open_data
"""

    patches = (patch(tmp_path / "a"), patch(tmp_path / "b"))
    with PixelRuns(programs, tmp_path / "run", tmp_path / "run", patches=patches) as runs:
        for number in range(2):
            errors = runs.errors(number)
            assert runs.processes[number].returncode == 1
            assert re.search(r"data\.cache_dir=\S+ of the processes \[1\] is another folder than that", errors), errors
            assert "Traceback" not in errors
    assert not list(tmp_path.glob("*/teacher")) and not list(tmp_path.glob("*/.shared*"))


def test_a_preflight_goes_on_together_when_one_process_fails_a_try(programs: RootPrograms, tmp_path: Path) -> None:
    quick = (
        "from logvggt_jax.training import preflight as flight\n"
        "from logvggt_jax.training.step.costs import StepCosts\n"
        "flight.step_costs = lambda *_: StepCosts(1, 1, {}, 1.0)\n"
        "flight.abstract_parameters = loop.abstract_parameters\n"
    )
    broken = (
        "from logvggt_jax.errors import InputError\n"
        "def fail(*_): raise InputError('scene0001: cannot be opened')\n"
        "flight._read_clips = fail\n"
    )
    with PixelRuns(programs, tmp_path, tmp_path, patches=(quick, quick + broken), flags=("--preflight",)) as runs:
        codes = [process.wait() for process in runs.processes]
        outputs = [(process.output.read_text(), process.error.read_text()) for process in runs.processes]
        assert codes == [1, 1], outputs
    assert "rooms: FAILED on process 1: scene0001: cannot be opened" in outputs[1][0]
    assert "checkpoint: " in outputs[0][0] and "checkpoint: " not in outputs[1][0]
    assert "preflight: 1 of the tries failed: rooms; see the lines above" in outputs[0][1] + outputs[1][1]
    assert not list(tmp_path.iterdir())


def test_a_process_that_never_joins_is_waited_for_as_long_as_stated(programs: RootPrograms, tmp_path: Path) -> None:
    with PixelRuns(programs, tmp_path, tmp_path, patches=("", "sys.exit()"), flags=("--join_seconds=2",)) as runs:
        errors = runs.errors(0)
        assert runs.processes[0].returncode == 1
    assert re.fullmatch(
        r"train.py: not all of the 2 processes joined within 2 s .*give each a --process_id of its own.*\n", errors
    )


@pytest.mark.slow
def test_two_processes_train_one_model(tmp_path: Path) -> None:
    address = f"localhost:{free_port()}"
    together = [
        started(
            tmp_path / "two",
            "--distributed",
            f"--coordinator={address}",
            "--num_processes=2",
            f"--process_id={process}",
        )
        for process in range(2)
    ]
    outputs = [process.communicate(timeout=600)[0] for process in together]
    assert [process.returncode for process in together] == [0, 0], outputs
    assert "step 4/4" in outputs[0]
    assert "step 4/4" not in outputs[1], "one process speaks"
    alone = started(tmp_path / "one")
    output = alone.communicate(timeout=600)[0]
    assert alone.returncode == 0, output

    ours, theirs = (read_metrics(tmp_path / name / "metrics.jsonl") for name in ("two", "one"))
    assert [entry["step"] for entry in ours] == [entry["step"] for entry in theirs]
    # The first step's loss is of the same parameters and clips; later ones drift with the order of sums.
    first = [next(entry["loss/total"] for entry in entries if "loss/total" in entry) for entries in (ours, theirs)]
    assert first[0] == pytest.approx(first[1], rel=1e-4)
    assert ours[-1]["validation/abs_rel"] == pytest.approx(theirs[-1]["validation/abs_rel"], rel=0.05)
    two, one = (load_model(tmp_path / name / "model")[1] for name in ("two", "one"))
    for a, b in zip(jax.tree.leaves(two), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(a, b, atol=5e-3)
