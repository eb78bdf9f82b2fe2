"""The command line: what a user types, right and wrong."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from logvggt_jax.config import ModelConfig
from logvggt_jax.weights import save_model

ROOT = Path(__file__).parents[2]


def run_eval(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "eval.py", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--output=nowhere"], "Flag --checkpoint must have a value"),
        (["--checkpoint=c", "--output=o", "--config.evaluation.strides=3"], "strides"),
        (["--checkpoint=c", "--output=o", "--data_root=d"], "leave --data_root=d out"),
        (["--checkpoint=does-not-exist", "--output=o"], "does-not-exist"),
        (["--checkpoint=c", "--output=o", "--config.evaluation.stride=0"], "stride must be at least 1"),
    ],
)
def test_wrong_arguments_end_in_a_message(arguments: list[str], message: str) -> None:
    result = run_eval("--config=configs/eval/rooms.py", *arguments)
    assert result.returncode != 0
    assert message in result.stderr + result.stdout
    assert not (ROOT / "o").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rooms", "seven_scenes"])
def test_an_evaluation_leaves_tables_json_and_figures(
    name: str, small_config: ModelConfig, small_variables: dict, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    save_model(tmp_path / "model", small_config, small_variables["params"])
    size = ["--config.evaluation.image_size=(28, 42)", "--config.evaluation.clip_lengths=(4, 6)"]
    options = [*size, f"--checkpoint={tmp_path / 'model'}", f"--output={tmp_path / 'out'}"]
    if name == "rooms":
        options.append("--config.rooms.num_rooms=2")
    else:
        options += [f"--data_root={request.getfixturevalue('seven_scenes_dir')}"]
        options += ["--config.evaluation.clips_per_sequence=2"]
    result = run_eval(f"--config=configs/eval/{name}.py", *options)
    assert result.returncode == 0, result.stderr
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert not results["skipped"]
    assert {(entry["frames"], entry["method"]) for entry in results["summary"]} == {
        (frames, method["name"]) for frames in (4, 6) for method in results["methods"]
    }
    depths = [entry["scale/abs_rel"] for entry in results["summary"] if entry["method"] != "static camera"]
    assert len(depths) == 8
    assert all(error > 0 for error in depths)
    report = (tmp_path / "out" / "report.md").read_text()
    assert results["command"] in report
    assert results["command"] in result.stdout
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 2 * 2 * 2
