"""A run that is killed at any moment, in the middle of a save too, ends as one that was left alone."""

from __future__ import annotations

import json
import os
import pickle
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from killed_runs import kill, standing_still
from orbax.checkpoint import StandardCheckpointer
from pixel_program import PIXEL_MODEL, PIXEL_SETTINGS
from root_programs import RootPrograms, Running

from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.reporting.metrics_log import read_metrics
from logvggt_jax.weights.checkpoints import read_provenance
from logvggt_jax.weights.digests import digests

# Starts the run with the quick model; says when it trains. A save takes its time, so that many kills fall into one.
RUN = """
import pickle, sys, time
from pathlib import Path
import jax
jax.config.update("jax_num_cpu_devices", 2)
sys.path.insert(0, sys.argv[3])
from conftest import PixelModel
from logvggt_jax.training.checkpoints import checkpoint_files
from logvggt_jax.training import loop
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import data_mesh
settings, params = pickle.loads(Path(sys.argv[1]).read_bytes())
config = TrainConfig.from_dict(settings)
loop.LogVGGT = lambda _: PixelModel(config.model)
loop.initial_parameters = lambda *_, **__: params
loop.abstract_parameters = lambda _: jax.eval_shape(lambda: params)
write = checkpoint_files.write_arrays
checkpoint_files.write_arrays = lambda *given: (write(*given), time.sleep(0.1))
print("begins", flush=True)
state = loop.train(config, Path(sys.argv[2]), mesh=data_mesh(2))
Path(sys.argv[2], "ended.pickle").write_bytes(pickle.dumps(jax.device_get(state)))
"""

# Two stages, with a save in the middle of the first.
SHORT = (
    *PIXEL_SETTINGS,
    "--config.stages.stage_1.steps=8",
    "--config.stages.stage_2.steps=2",
    "--config.stages.stage_2.clip_length=4",
    "--config.log_every=1",
    "--config.save_every=4",
    "--validation_source=none",
)
# One line for each program that is compiled or read.
TOLD = """
import jax.monitoring
jax.monitoring.register_event_listener(
    lambda event, **_: print(event.removeprefix("/jax/compilation_cache/"), file=sys.stderr)
)
"""


def test_a_killed_run_ends_as_one_that_was_left_alone(programs: RootPrograms, tmp_path: Path) -> None:
    def start(name: str, *, patch: str = "") -> Running:
        own = (f"--workdir={tmp_path / name}", f"--compilation_cache={tmp_path / 'cache'}")
        return programs.start("train.py", *SHORT, *own, first=PIXEL_MODEL + TOLD + patch)

    killed = start("killed", patch=standing_still(6))
    kill(killed, tmp_path / "killed", step=6, saved=4)
    resumed, alone = start("killed"), start("alone")
    assert [resumed.wait(), alone.wait()] == [0, 0], resumed.error.read_text() + alone.error.read_text()
    # The step, of which both stages have the same, is compiled once and read twice.
    assert len(list((tmp_path / "cache").glob("jit_on_all_devices-*-cache"))) == 1
    first, *later = (run.error.read_text().splitlines() for run in (killed, alone, resumed))
    assert "cache_misses" in first and all("cache_hits" in told for told in later) and "cache_misses" not in later[0]
    assert "4/10 steps done, results in" in resumed.output.read_text()

    ends = [tmp_path / name for name in ("alone", "killed")]
    lines = [(folder / "metrics.jsonl").read_bytes() for folder in ends]
    assert lines[0] == lines[1] and lines[0].count(b"loss/total") == 10
    states = [json.loads((folder / "checkpoints" / "10" / "meta" / "metadata").read_text()) for folder in ends]
    assert states[0]["digests"] == states[1]["digests"]
    models = [digests(StandardCheckpointer().restore(folder / "model" / "params")) for folder in ends]
    assert models[0] == models[1]


def _lines(file: Path) -> list[dict[str, Any]]:
    return read_metrics(file) if file.exists() else []


@pytest.mark.slow
def test_twelve_kills_change_nothing(run_config: TrainConfig, pixel_params: Any, tmp_path: Path) -> None:
    stages = [{**stage, "steps": 30} for stage in run_config.to_dict()["stages"]]
    validation = {
        "sources": [{**run_config.to_dict()["data"]["sources"][0], "split": "val"}],
        "every": 4,
        "num_clips": 2,
        "clip_length": 3,
        "stride": 2,
        "size": [28, 42],
        "best": "abs_rel",
    }
    settings = {**run_config.to_dict(), "stages": stages, "validation": validation, "save_every": 2, "log_every": 2}
    given = tmp_path / "run.pickle"
    given.write_bytes(pickle.dumps((settings, pixel_params)))

    def start(workdir: Path) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", RUN, str(given), str(workdir), str(Path(__file__).parent)]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        return subprocess.Popen(command, text=True, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)

    def finish(run: subprocess.Popen[str]) -> None:
        output = run.communicate(timeout=300)[0]
        assert run.returncode == 0, output

    def half_written() -> bool:
        halves = ("*.partial", "checkpoints/*.partial")
        return any(next((tmp_path / "killed").glob(half), None) for half in halves)

    finish(start(tmp_path / "alone"))
    total, kills = sum(stage["steps"] for stage in stages), int(os.environ.get("LOGVGGT_KILLS", "12"))
    written, generator, in_a_save = tmp_path / "killed" / "metrics.jsonl", random.Random(0), 0
    for number in range(kills):
        run = start(tmp_path / "killed")
        assert run.stdout is not None
        while "begins" not in run.stdout.readline():
            pass
        # By the steps that are done, not by the clock, which is right on no other machine: spread over the whole run,
        # one kill in four while it still starts.
        least = 0 if number % 4 == 1 else total * number // kills
        while least and not any(line["step"] >= least for line in _lines(written)):
            assert run.poll() is None, run.stdout.read()
            time.sleep(0.01)
        time.sleep(generator.uniform(0.0, 0.3 if least else 1.0))
        while number % 3 == 0 and run.poll() is None and not half_written():
            time.sleep(0.001)
        assert run.poll() is None, "it has ended before it was killed"
        run.send_signal(signal.SIGKILL)
        run.communicate()
        in_a_save += half_written()
    assert in_a_save >= kills // 6, "hardly a kill fell into a save"
    finish(start(tmp_path / "killed"))
    ends = [pickle.loads((tmp_path / name / "ended.pickle").read_bytes()) for name in ("alone", "killed")]
    assert digests(ends[0]) == digests(ends[1])
    lines = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("alone", "killed")]
    assert lines[0] == lines[1]
    best = [read_provenance(tmp_path / name / "best").training for name in ("alone", "killed")]
    assert best[0] is not None and best[1] is not None and best[0].steps == best[1].steps
    # What the quick model has are not the parameters of its configuration, which `load_model` refuses.
    models = [StandardCheckpointer().restore(tmp_path / name / "best" / "params") for name in ("alone", "killed")]
    assert digests(models[0]) == digests(models[1])
    left = sorted(path.name for path in (tmp_path / "killed").iterdir())
    assert not [name for name in left if name.endswith((".partial", ".old"))]
