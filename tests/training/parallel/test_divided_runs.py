"""Processes that each hold a part of the state, of which none has the whole, go on from a save as if never ended."""

import re
import shutil
import signal
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from orbax.checkpoint import StandardCheckpointer
from pixel_program import LAYERED_MODEL, PIXEL_MODEL, PIXEL_SETTINGS, READERS_KILLED, PixelRuns
from root_programs import RootPrograms

from logvggt_jax.training.reporting.metrics_log import read_metrics
from logvggt_jax.weights.digests import digests

SETTINGS = (
    "--config.shard_parameters=True",
    "--config.average=0.5",
    "--config.stages.stage_1.steps=4",
    "--config.stages.stage_1.batch_size=4",
    "--config.stages.stage_2.steps=1",
    "--config.stages.stage_2.clip_length=4",
    "--config.stages.stage_2.batch_size=4",
    "--config.log_every=1",
    "--config.save_every=2",
    "--validation_source=none",
)
# As many devices as the test says, however many cores there are.
DEVICES = """
import jax
from logvggt_jax.training.parallel import sharding
sharding.use_cpu_cores = lambda *_, **__: jax.config.update("jax_num_cpu_devices", {})
"""
ONE_DEVICE = LAYERED_MODEL + DEVICES.format(1)
# Kills its process after step 3, when the save of step 2 is on the disk.
KILLED = """
import os, signal, time
from pathlib import Path
write = loop.MetricsLog.write
def killed(log, step, *given, **words):
    write(log, step, *given, **words)
    while step == 3 and not Path({!r}).is_dir():
        time.sleep(0.02)
    if step == 3:
        os.kill(os.getpid(), signal.SIGKILL)
loop.MetricsLog.write = killed
"""
# In place of training: the first state is saved and restored; each process says of which parameters it holds a part.
RESTORED = """
import jax
from logvggt_jax.training.checkpoints.checkpoint_files import Position
from logvggt_jax.weights.digests import digests, is_divided, named_leaves
def saved_and_restored(run, *_):
    saved = digests(run.state)
    run.checkpoints.save(run.state, Position(0, {"examples": 7}))
    run.checkpoints.wait()
    like = run.program.abstract_state
    run.state, position = run.checkpoints.restore(like)
    assert position == Position(0, {"examples": 7}), position
    assert digests(run.state) == saved
    assert all(x.sharding == like.sharding for x, like in zip(*map(jax.tree.leaves, (run.state, like))))
    print("divided:", *(name for name, leaf in named_leaves(run.state.params) if is_divided(leaf)))
loop._Run.train = saved_and_restored
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of all runs and of their rooms, which the first one renders."""
    return tmp_path_factory.mktemp("divided")


@pytest.fixture(scope="module")
def alone(programs: RootPrograms, folder: Path) -> Path:
    """The run of two processes that were left alone."""
    return _finished_by_two(programs, folder / "alone")


@pytest.fixture(scope="module")
def killed(programs: RootPrograms, folder: Path, alone: Path) -> Path:
    """One whose second process was killed a step after a save."""
    workdir = folder / "killed"
    patches = (ONE_DEVICE, ONE_DEVICE + KILLED.format(str(workdir / "checkpoints" / "2")))
    with PixelRuns(programs, workdir, workdir, patches=patches, flags=_flags(workdir)) as runs:
        assert [process.wait() for process in runs.processes] == [1, -signal.SIGKILL], runs.errors(0)
    return workdir


def _flags(workdir: Path) -> tuple[str, ...]:
    return *SETTINGS, f"--config.data.cache_dir={workdir.parent / 'rooms'}"


def _finished_by_two(programs: RootPrograms, workdir: Path) -> Path:
    patches = (ONE_DEVICE, ONE_DEVICE)
    with PixelRuns(programs, workdir, workdir, patches=patches, flags=_flags(workdir)) as runs:
        codes = [process.wait() for process in runs.processes]
        assert codes == [0, 0], [runs.errors(number) for number in range(2)]
    return workdir


def _parameters(workdir: Path) -> Any:
    # They are not those of the configuration, which `load_model` refuses.
    return StandardCheckpointer().restore(workdir / "model" / "params")


def _same_end(run: Path, alone: Path) -> None:
    """To the last bit."""
    ours, theirs = ((folder / "metrics.jsonl").read_bytes() for folder in (run, alone))
    assert ours == theirs and ours.count(b"loss/total") == 5
    assert digests(_parameters(run)) == digests(_parameters(alone))


def test_two_processes_restore_the_parts_that_they_saved(programs: RootPrograms, tmp_path: Path) -> None:
    patch = ONE_DEVICE + RESTORED
    with PixelRuns(programs, tmp_path, tmp_path, patches=(patch, patch), flags=SETTINGS) as runs:
        codes = [process.wait() for process in runs.processes]
        assert codes == [0, 0], [runs.errors(number) for number in range(2)]
        for process in runs.processes:
            divided = re.findall(r"^divided: (.*)", process.output.read_text(), re.MULTILINE)
            names = "aggregator/embed/kernel aggregator/frame_blocks/kernel depth_head/kernel"
            assert divided == [names], "two divides neither three nor nine"


@pytest.mark.slow
def test_two_processes_go_on_from_their_parts_as_if_none_had_been_killed(
    programs: RootPrograms, folder: Path, alone: Path, killed: Path
) -> None:
    resumed = _finished_by_two(programs, shutil.copytree(killed, folder / "two"))
    _same_end(resumed, alone)


@pytest.mark.slow
def test_two_processes_go_on_from_where_the_clips_of_one_ended(
    programs: RootPrograms, folder: Path, alone: Path
) -> None:
    workdir = folder / "ended"
    # The fourth of four batches of four clips.
    patches = (ONE_DEVICE, ONE_DEVICE + READERS_KILLED.format(12))
    with PixelRuns(programs, workdir, workdir, patches=patches, flags=_flags(workdir)) as runs:
        assert [process.wait() for process in runs.processes] == [1, 1]
        assert "it ended with: InputError: reading workers were killed" in runs.errors(0)
    assert (workdir / "checkpoints" / "3").is_dir()
    _same_end(_finished_by_two(programs, workdir), alone)


@pytest.mark.slow
def test_one_process_goes_on_from_the_parts_of_two_on_other_devices(
    programs: RootPrograms, folder: Path, alone: Path, killed: Path
) -> None:
    resumed = shutil.copytree(killed, folder / "one")
    first = PIXEL_MODEL + LAYERED_MODEL + DEVICES.format(4)
    done = programs("train.py", *PIXEL_SETTINGS, *_flags(resumed), f"--workdir={resumed}", first=first)
    assert done.returncode == 0, done.stderr
    assert "4 devices, 2/5 steps done" in done.stdout
    ours, theirs = (read_metrics(run / "metrics.jsonl") for run in (resumed, alone))
    losses = [[entry["loss/total"] for entry in entries] for entries in (ours, theirs)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), _parameters(resumed), _parameters(alone)
    )
