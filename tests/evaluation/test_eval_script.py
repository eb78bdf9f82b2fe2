"""The command line: one evaluation from its flags to its tables, and what a user types wrong."""

import functools
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from root_programs import RootPrograms

from logvggt_jax.config import ModelConfig
from logvggt_jax.weights import Provenance, save_model

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run_eval(programs: RootPrograms) -> Callable[..., subprocess.CompletedProcess[str]]:
    """`eval.py` with the given arguments."""
    return functools.partial(programs, "eval.py")


def test_an_evaluation_leaves_tables_json_and_figures(
    run_eval: Callable, small_config: ModelConfig, small_variables: dict, tmp_path: Path
) -> None:
    save_model(tmp_path / "model", small_config, small_variables["params"], Provenance("vggt", 42))
    result = run_eval(
        "--config=configs/eval/rooms.py",
        f"--checkpoint={tmp_path / 'model'}",
        f"--output={tmp_path / 'out'}",
        "--config.methods=('windows',)",
        "--config.baselines=False",
        "--config.options.num_rooms=1",
        "--config.evaluation.image_size=(28, 42)",
        "--config.evaluation.clip_lengths=(4,)",
    )
    assert result.returncode == 0, result.stderr
    assert "\neval.py: warning: these weights were trained for vggt, not for windows" in f"\n{result.stderr}"
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert not results["skipped"]
    assert [(entry["frames"], entry["method"]) for entry in results["summary"]] == [(4, "LoG-VGGT")]
    assert results["command"] in (tmp_path / "out" / "report.md").read_text()
    assert results["command"] in result.stdout
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config.evaluation.strides=3"], "no such field: 'strides' Did you mean \"stride\""),
        (
            ["--config.settings.anchored-window.window=3"],
            "--config.settings.anchored-window.window: no field is named so",
        ),
        (["--config.evaluation..stride=3"], "--config.evaluation..stride: no field is named so"),
        (["--config.=3"], "--config.: no field is named so"),
        (["--config.options.num_rooms[0]=3"], "no such field: <class 'int'> does not support integer indexing [0]"),
        (["--config.evaluation.clip_lengths[0]=3"], "no such field: 0 is not a valid index for <class 'tuple'>"),
        (["--config.methods.x=3"], "no such field: tuple indices must be integers"),
        (["--config=configs/eval/none.py"], "configs/eval/none.py"),
        (["--flagfile=none.txt"], "Unable to open flagfile: [Errno 2] No such file or directory: 'none.txt'"),
        (["--data_root=d", "--config.evaluation.image_size=(28, 42)"], "leave --data_root=d out"),
    ],
)
def test_what_cannot_be_used_is_one_line(
    run_eval: Callable, arguments: list[str], message: str, tmp_path: Path
) -> None:
    output = tmp_path / "out"
    result = run_eval("--config=configs/eval/rooms.py", "--checkpoint=c", f"--output={output}", *arguments)
    assert result.returncode == 1 and result.stderr.startswith("eval.py: ")
    assert result.stderr.count("\n") == 1 and message in result.stderr and not output.exists()


def test_help_lists_the_configuration(run_eval: Callable) -> None:
    assert "--config:" in run_eval("--help").stdout


def test_ctrl_c_is_one_line(run_eval: Callable, tmp_path: Path) -> None:
    config = tmp_path / "config.py"
    config.write_text("def get_config():\n    raise KeyboardInterrupt\n")
    result = run_eval(f"--config={config}", "--checkpoint=c", f"--output={tmp_path / 'out'}")
    assert (result.returncode, result.stderr) == (130, "eval.py: interrupted\n")


def test_a_bug_keeps_its_traceback(run_eval: Callable, tmp_path: Path) -> None:
    fault = """
import logvggt_jax.evaluation.run as run

def broken(*_, **__):
    raise ValueError("a bug")

run.run_evaluation = broken
"""
    flags = ["--config=configs/eval/rooms.py", "--checkpoint=c", f"--output={tmp_path}"]
    result = run_eval(*flags, first=fault)
    assert result.returncode != 0
    assert "Traceback" in result.stderr and "ValueError: a bug" in result.stderr


def test_missing_flags_are_named(run_eval: Callable) -> None:
    result = run_eval("--config=configs/eval/rooms.py", "--output=nowhere")
    assert result.returncode != 0
    assert result.stderr == "eval.py: missing: --checkpoint; --help says what each is\n"
    assert not (ROOT / "nowhere").exists()


@pytest.mark.slow
def test_real_frames_are_evaluated(
    run_eval: Callable, small_config: ModelConfig, small_variables: dict, tmp_path: Path, seven_scenes_dir: Path
) -> None:
    save_model(tmp_path / "model", small_config, small_variables["params"])
    size = ["--config.evaluation.image_size=(28, 42)", "--config.evaluation.clip_lengths=(4, 6)"]
    options = [*size, "--compilation_cache=none", f"--checkpoint={tmp_path / 'model'}", f"--output={tmp_path / 'out'}"]
    options += [f"--data_root={seven_scenes_dir}", "--config.evaluation.clips_per_sequence=2"]
    result = run_eval("--config=configs/eval/seven_scenes.py", *options)
    assert result.returncode == 0, result.stderr
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert not results["skipped"]
    assert {(entry["frames"], entry["method"]) for entry in results["summary"]} == {
        (frames, method["name"]) for frames in (4, 6) for method in results["methods"]
    }
    depths = [entry["scale/abs_rel"] for entry in results["summary"] if entry["method"] != "static camera"]
    assert len(depths) == 2 * 6 and all(error > 0 for error in depths)


@pytest.mark.slow
def test_the_papers_benchmarks_run_on_real_frames_and_go_on_after_a_kill(
    run_eval: Callable, small_config: ModelConfig, small_variables: dict, tmp_path: Path, seven_scenes_dir: Path
) -> None:
    save_model(tmp_path / "model", small_config, small_variables["params"])
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "seven_scenes").symlink_to(seven_scenes_dir)
    options = ["--config=configs/eval/paper.py", "--config.protocol.longer_edge=42", f"--output={tmp_path / 'out'}"]
    options += [f"--checkpoint={tmp_path / 'model'}", f"--data_root={tmp_path / 'data'}", "--compilation_cache=none"]
    options += ["--config.protocol.max_points=5000", "--config.protocol.options.rooms.num_rooms=1"]
    options += ["--config.timings.lengths=(20, 40)", "--config.timings.rounds=1"]
    first = run_eval(*options, "--config.benchmarks=('seven_scenes-reconstruction-*', 'rooms-12', 'bonn-*')")
    assert first.returncode == 0, first.stderr
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    used = {b["name"]: b["frames_used"] for b in results["benchmarks"]}
    assert [used[f"seven_scenes-reconstruction-{n}"] for n in (200, 500, 1000)] == [[n, n] for n in (200, 500, 1000)]
    entry = next(e for e in results["summary"] if e["benchmark"] == "seven_scenes-reconstruction-1000")
    assert entry["clips_points"] == entry["clips_pose"] == entry["clips_sfm/pose"] == 1
    assert sum(bool(b["missing"]) for b in results["benchmarks"]) == 3
    lines = tmp_path / "out" / "clips.jsonl"
    lines.write_text("".join(lines.read_text().splitlines(keepends=True)[:-2]))
    second = run_eval(*options, "--config.benchmarks=('seven_scenes-reconstruction-*', 'rooms-12', 'bonn-*')")
    assert second.returncode == 0, second.stderr
    again = json.loads((tmp_path / "out" / "results.json").read_text())
    assert again["summary"] == results["summary"]
    assert again["environments"] == results["environments"], "both runs were made in one"
    assert again["timings"] == results["timings"] and "this run: VGGT on chunks" in second.stdout
