"""`train.py` itself: one step of a real model, its validation and its files; and what it says when it ends badly."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from killed_runs import kill, standing_still
from orbax.checkpoint import StandardCheckpointer
from root_programs import RootPrograms, Running

from logvggt_jax.training.reporting.metrics_log import read_metrics
from logvggt_jax.weights.checkpoints import load_model, read_provenance

SETTINGS = (
    "--config=configs/tiny.py",
    "--config.model.encoder.depth=1",
    # As in the paper; its backward pass would take a second of compilation.
    "--config.model.encoder.frozen=True",
    "--config.stages.stage_1.steps=1",
    "--config.stages.stage_2.steps=1",
    "--config.stages.stage_2.clip_length=4",
    "--config.data.sources.rooms.options.num_rooms=4",
    "--config.data.sources.rooms.options.num_frames=24",
    "--config.validation.num_clips=2",
    "--config.validation.clip_length=4",
    "--config.validation.sources.rooms.options.num_rooms=2",
)


def batches_of(clips: int) -> tuple[str, str]:
    """Settings with which so many cores of a CPU share a step: on one it compiles a third faster than on two."""
    return f"--config.stages.stage_1.batch_size={clips}", f"--config.stages.stage_2.batch_size={clips}"


@pytest.fixture(scope="module")
def run_train(programs: RootPrograms) -> Callable[..., subprocess.CompletedProcess[str]]:
    """`train.py` with `SETTINGS`, a folder and other arguments."""
    return lambda workdir, *arguments, **first: programs(
        "train.py", *SETTINGS, f"--workdir={workdir}", *arguments, **first
    )


@pytest.fixture(scope="module")
def begun(run_train: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that its time limit has ended after the first step."""
    workdir = tmp_path_factory.mktemp("real") / "run"
    finished = run_train(workdir, *batches_of(1), "--config.max_minutes=1e-9")
    assert finished.returncode == 0, finished.stderr
    assert "stage_1: step for images of 56 x 70 compiled" in finished.stdout
    assert "step 1/2 stage_1" in finished.stdout and "stopping after step 1" in finished.stdout
    return workdir


def test_a_real_model_is_trained_validated_and_saved(begun: Path) -> None:
    before, first = read_metrics(begun / "metrics.jsonl")
    assert np.isfinite([first["loss/total"], before["validation/abs_rel"]]).all()
    for name, steps in (("model", 1), ("best", 0)):
        model, variables = load_model(begun / name)
        assert model.config.encoder.depth == 1
        assert set(variables["params"]) >= {"encoder", "aggregator", "camera_head", "depth_head"}
        training = read_provenance(begun / name).training
        assert training is not None and training.steps == steps


def test_gradients_reach_what_is_trained_and_nothing_else(begun: Path) -> None:
    """By Adam's first moments; GCCR's output, which begins at zero, hides its other layers."""
    state = StandardCheckpointer().restore(begun / "checkpoints" / "1" / "state")
    reached, silent = set(), set()
    for path, moment in jax.tree_util.tree_leaves_with_path(state["opt_state"]):
        keys = [getattr(key, "key", None) for key in path]
        if "mu" in keys:
            module, layer, *_ = keys[keys.index("mu") + 1 :]
            assert np.isfinite(moment).all(), (module, layer)
            (reached if np.any(moment) else silent).add((module, layer))
    assert silent == {("gccr", layer) for layer in ("camera_norm", "key", "query", "register_norm", "value")}
    assert {module for module, _ in reached} == {"aggregator", "camera_head", "depth_head", "gccr"}, (
        "all but the encoder"
    )


@pytest.mark.slow
def test_the_same_command_goes_on_with_parameters_in_parts(run_train: Callable, tmp_path: Path) -> None:
    begun, workdir = tmp_path / "begun", tmp_path / "run"
    finished = run_train(begun, *batches_of(2), "--config.max_minutes=1e-9")
    assert finished.returncode == 0, finished.stderr
    shutil.copytree(begun, workdir)
    finished = run_train(workdir, *batches_of(2), "--config.shard_parameters=True")
    assert finished.returncode == 0, finished.stderr
    assert "step 2/2 stage_2" in finished.stdout and "validation after step 2" in finished.stdout
    earlier, (_, first, second, validation) = (read_metrics(at / "metrics.jsonl") for at in (begun, workdir))
    assert first == earlier[1] and second["step"] == 2
    assert np.isfinite([second["loss/total"], validation["validation/abs_rel"]]).all()


@pytest.mark.slow
def test_a_killed_run_of_the_real_model_ends_as_one_that_was_left_alone(programs: RootPrograms, tmp_path: Path) -> None:
    steps = ("--config.stages.stage_1.steps=4", "--config.save_every=2", "--config.log_every=1")

    def start(name: str, *, first: str = "") -> Running:
        folders = (f"--workdir={tmp_path / name}", f"--compilation_cache={tmp_path / 'cache'}")
        return programs.start("train.py", *SETTINGS, *batches_of(1), *steps, *folders, first=first)

    kill(start("killed", first=standing_still(3)), tmp_path / "killed", step=3, saved=2)
    resumed = start("killed")
    assert resumed.wait() == 0, resumed.error.read_text()
    assert "2/5 steps done, results in" in resumed.output.read_text()
    alone = start("alone")
    assert alone.wait() == 0, alone.error.read_text()
    ends = [tmp_path / name for name in ("alone", "killed")]
    lines = [(folder / "metrics.jsonl").read_bytes() for folder in ends]
    assert lines[0] == lines[1] and lines[0].count(b"loss/total") == 5
    states = [json.loads((folder / "checkpoints" / "5" / "meta" / "metadata").read_text()) for folder in ends]
    assert states[0]["digests"] == states[1]["digests"]


@pytest.mark.slow
def test_a_preflight_tries_all_that_a_run_of_the_real_model_needs(run_train: Callable, tmp_path: Path) -> None:
    finished = run_train(tmp_path / "run", *batches_of(1), "--preflight")
    assert finished.returncode == 0, finished.stderr
    tries = re.findall(
        r"^(?:all-reduce|work folder|data sets|rooms|validation|checkpoint|step of stage_\d): (.*)$",
        finished.stdout,
        re.MULTILINE,
    )
    assert len(tries) == 8 and all(re.search(r"\(\d+\.\d s\)$", line) for line in tries)
    *_, checkpoint, first, second = tries
    assert re.match(r"0\.\d+ GiB with the model written to .* and deleted", checkpoint)
    assert re.match(r"1 clips a device of 4 frames at 56x70, 0\.\d+ GiB, compiled", first)
    assert re.match(r"1 clips a device of 4 frames at 56x70, 0\.\d+ GiB, compiled", second)
    assert finished.stdout.endswith("preflight: all is well\n")
    assert not any((tmp_path / "run").glob("*preflight*"))


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        ("ValueError('a bug')", 1, "Traceback (most recent call last)"),
        ("KeyboardInterrupt", 130, "train.py: interrupted; the same command goes on"),
    ],
)
def test_a_fault_of_ours_keeps_its_traceback(
    run_train: Callable, tmp_path: Path, error: str, code: int, said: str
) -> None:
    """What a user can mend, or wanted, is one line; anything else shows where it arose."""
    fault = (
        "import logvggt_jax.training.config as config\n"
        "def fail(values):\n"
        f"    raise {error}\n"
        "config.TrainConfig.from_dict = fail\n"
    )
    finished = run_train(tmp_path / "run", first=fault)
    assert finished.returncode == code and finished.stderr.startswith(said)
    assert "ValueError: a bug" in finished.stderr or finished.stderr.count("\n") == 1


def test_a_work_folder_at_home_is_one_folder(run_train: Callable, tmp_path: Path) -> None:
    """A shell leaves `~` behind `=` as it is: half of a run's files lay in a folder of that name."""
    given = (
        f"import os; os.environ['HOME'] = {str(tmp_path)!r}\n"
        "import logvggt_jax.training.loop as loop, logvggt_jax.training.preflight as preflight\n"
        "loop.train = preflight.preflight = lambda config, workdir, *_, **__: print(workdir)\n"
    )
    for flags in ((), ("--preflight",)):
        assert run_train("~/run", *flags, first=given).stdout == f"{tmp_path / 'run'}\n"


def test_a_field_of_any_type_may_be_left_out(run_train: Callable, tmp_path: Path) -> None:
    """The library reads None where tuples stand, and nowhere else."""
    given = (
        "import logvggt_jax.training.loop as loop\n"
        "loop.train = lambda config, *_, **__: print(config.validation.best, config.max_minutes, config.model.dtype)\n"
    )
    flags = ("--config.validation.best=None", "--config.max_minutes=None", "--config.model.dtype=bfloat16")
    assert run_train(tmp_path, *flags, first=given).stdout == "None None bfloat16\n"
    finished = run_train(tmp_path, "--config.optimizer.learning_rate=None", first=given)
    assert finished.stderr == "train.py: config.optimizer.learning_rate must be a number, got None\n"
    finished = run_train(tmp_path, "--config.validation.bst=None", first=given)
    assert finished.stderr.startswith("train.py: --config has no such field: ") and len(finished.stderr) < 200
    assert '"best"' in finished.stderr


def test_an_argument_that_is_no_flag_is_one_line(run_train: Callable, tmp_path: Path) -> None:
    finished = run_train(tmp_path, "configs/h20.py")
    assert finished.returncode == 1
    expected = "train.py: unknown argument 'configs/h20.py'; settings are given as --config.NAME=VALUE\n"
    assert finished.stderr == expected


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--join_seconds=600"], "--join_seconds is of runs of several processes: add --distributed"),
        (["--num_processes=2", "--process_id=0"], "--num_processes is of runs of several processes: add --distributed"),
        (["--workdir="], "--workdir is empty: name a folder"),
        (["--watchdog=-1"], "flag --watchdog=-1: -1.0 is not a non-negative number"),
        (["--preflight", "--dry_run"], "--preflight tries what --dry_run only compiles: give one of them"),
        (["--source=seven_scene=/data"], "unknown data set 'seven_scene': choose one of "),
        (["--compilation_cache=/dev/null"], "/dev/null is no folder: give another --compilation_cache"),
        (
            ["--config=configs/h20.py:/data,stage_9"],
            "--config: configs/h20.py has stages stage_1, stage_2, got 'stage_9'",
        ),
    ],
)
def test_flags_that_would_do_something_else_are_refused(
    programs: RootPrograms, tmp_path: Path, arguments: list[str], said: str
) -> None:
    finished = programs("train.py", "--config=configs/tiny.py", f"--workdir={tmp_path / 'run'}", *arguments)
    assert finished.returncode == 1 and finished.stderr.startswith(f"train.py: {said}")
    assert finished.stderr.count("\n") == 1 and not (tmp_path / "run").exists()
