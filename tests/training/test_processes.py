"""Two processes that train together give one process's numbers and leave one set of files."""

import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from logvggt_jax.training import processes
from logvggt_jax.training.metrics_log import read_metrics
from logvggt_jax.training.processes import any_process, check_agreement, join_processes
from logvggt_jax.weights.checkpoints import load_model

ROOT = Path(__file__).parents[2]
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
    "--config.validation.source.options.num_rooms=4",
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
        processes.multihost_utils, "process_allgather", lambda digest: np.stack([digest, digest + 1, digest])
    )
    with pytest.raises(ValueError, match=r"the data of the processes \[1\] differ from those of process 0"):
        check_agreement("the data", {"a": 1})


def test_half_an_address_is_refused() -> None:
    with pytest.raises(ValueError, match="all of --coordinator, --num_processes and --process_id"):
        join_processes(coordinator="localhost:1234")


@pytest.mark.slow
def test_two_processes_train_one_model(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        address = f"localhost:{probe.getsockname()[1]}"
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
    assert ours[0]["loss/total"] == pytest.approx(theirs[0]["loss/total"], rel=1e-4)
    assert ours[-1]["validation/abs_rel"] == pytest.approx(theirs[-1]["validation/abs_rel"], rel=0.05)
    two, one = (load_model(tmp_path / name / "model")[1] for name in ("two", "one"))
    for a, b in zip(jax.tree.leaves(two), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(a, b, atol=5e-3)
