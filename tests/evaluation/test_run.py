"""Whole evaluations as eval.py makes them: a configuration and a model folder in, tables out."""

import copy
import csv
import importlib
import io
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from logvggt_jax import LogVGGT
from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import DiskError, InputError, OutputExists
from logvggt_jax.evaluation import run as run_module
from logvggt_jax.evaluation.methods.method import Checkpoint
from logvggt_jax.evaluation.report.report import print_report
from logvggt_jax.evaluation.run import run_evaluation
from logvggt_jax.files import FolderLock
from logvggt_jax.weights import Provenance, save_model

ROOT = Path(__file__).parents[2]


def configuration(name: str, changes: dict[str, Any]) -> dict[str, Any]:
    """A file of configs/eval with some fields changed, by their dotted names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        values = copy.deepcopy(importlib.import_module(f"configs.eval.{name}").get_config().to_dict())
    for path, value in changes.items():
        *parents, field = path.split(".")
        target = values
        for parent in parents:
            target = target[parent]
        target[field] = value
    return values


@pytest.mark.parametrize(
    ("name", "changes", "data_root", "message"),
    [
        ("rooms", {}, None, "no-model"),
        ("rooms", {}, "d", "leave --data_root=d out"),
        ("rooms", {"evaluation.stride": 0}, None, r"config\.evaluation\.stride must be"),
        ("rooms", {"settings.chunks.overlap": 12}, None, "below the chunk size 12, got 12"),
        ("rooms", {"options.number": 3}, None, "unknown option 'number'"),
        ("rooms", {"options.num_frames": "many"}, None, "rooms: num_frames must be a whole number, got 'many'"),
        (
            "rooms",
            {"options.speed": (1, 2, 3)},
            None,
            r"rooms: speed must be a number or a list of 2 .*, got",
        ),
        (
            "rooms",
            {"dataset": "seven_scenes"},
            None,
            "seven_scenes: unknown option 'num_rooms'; known are none, and num_rooms is one of rooms: take a "
            "configuration of seven_scenes",
        ),
        ("methods", {"settings.rolling.budget": 3}, None, "RollingSettings.budget: 3 tokens leave .* take at least"),
        ("methods", {"settings.pruned.cap": 3}, None, "PrunedSettings.cap: 3 tokens are fewer than"),
        (
            "paper",
            {"benchmarks": ("rooms-12",), "methods": ("windows", "pruned"), "settings.pruned": {"cap": 3}},
            None,
            "PrunedSettings.cap: 3 tokens are fewer than the 1041 of a frame",
        ),
        ("rooms", {"options.height": 28}, None, "rooms: height follows from the rest of the run"),
        ("paper", {"protocol.options.room": {}}, None, "unknown data set 'room'"),
        ("paper", {"protocol.options.rooms.number": 3}, None, "rooms: unknown option 'number'"),
        ("paper", {"protocol.options.rooms.num_frames": 0}, None, "rooms: num_frames must be at least 1"),
        ("seven_scenes", {}, None, "give its folder with --data_root"),
        ("seven_scenes", {}, "no-data", "no-data"),
        ("paper", {}, "no-data", "no-data: no such folder"),
        ("paper", {"benchmarks": ("sintell",)}, None, "no benchmark is named 'sintell'"),
    ],
)
def test_what_cannot_be_used_is_named_before_anything_is_written(
    name: str,
    changes: dict[str, Any],
    data_root: str | None,
    message: str,
    tmp_path: Path,
    small_config: ModelConfig,
    small_variables: dict[str, Any],
) -> None:
    values, model = configuration(name, changes), tmp_path / "no-model"
    if message != "no-model":
        save_model(model, small_config, small_variables["params"], Provenance("windows", 42))
    with pytest.raises(InputError, match=message) as raised:
        run_evaluation(values, model, tmp_path / "out", data_root=data_root, command="command")
    assert "\n" not in str(raised.value) and not (tmp_path / "out").exists()


def test_a_model_that_does_not_say_its_size_asks_for_one(
    small_config: ModelConfig, small_variables: dict[str, Any], tmp_path: Path
) -> None:
    values = configuration("rooms", {"options.num_rooms": 1, "methods": ("windows",)})
    save_model(tmp_path / "model", small_config, small_variables["params"])
    with pytest.raises(InputError, match=r"does not say at which image size .*--config\.evaluation\.image_size"):
        run_evaluation(values, tmp_path / "model", tmp_path / "other", command="command")


def test_the_model_and_all_baselines_make_a_table(
    small_config: ModelConfig, small_variables: dict[str, Any], tmp_path: Path
) -> None:
    save_model(tmp_path / "model", small_config, small_variables["params"], Provenance("windows", 42))
    clips = {"clip_lengths": (4,), "max_points": 800, "figures": 1}
    changes = {f"evaluation.{name}": value for name, value in clips.items()}
    changes |= {"options.num_rooms": 1, "methods": ("windows",)}
    values, output = configuration("rooms", changes), tmp_path / "out"
    results = run_evaluation(values, tmp_path / "model", output, command="command")
    assert json.loads((output / "results.json").read_text()) == results
    assert not results["skipped"] and not results["failures"]
    assert results["benchmarks"][0]["images"].startswith("42 x 28 pixels"), "as the model was trained at"
    names = ["LoG-VGGT", "constant depth", "mean depth map", "static camera", "untrained network"]
    assert [method["name"] for method in results["methods"]] == names
    assert [entry["method"] for entry in results["summary"]] == names
    trained, untrained = results["summary"][0], results["summary"][-1]
    assert trained["scale/abs_rel"] != untrained["scale/abs_rel"]

    print_report(results, Console(file=(terminal := io.StringIO())))
    markdown, shown = (output / "report.md").read_text(), f"{trained['scale/abs_rel']:.4f}"
    for text in (terminal.getvalue(), markdown):
        assert all(name in text for name in names)
        assert "training split of procedural rooms" in text and "†" in text and shown in text
        assert re.search(r"To get these numbers again:\s+command\n", text)
    # The pictures of the first clip are drawn for the first row, and the page holds them.
    stems = {path.stem.rpartition("_")[2] for path in (output / "figures").iterdir()}
    assert stems == {"depth", "points", "trajectory"}
    page = (output / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert not re.search(r'(src|href)="(?!data:)', page), "the page refers to no other file"
    rows = list(csv.reader((output / "tables" / "01-depth-clips-of-4-frames.csv").read_text().splitlines()))
    assert rows[0][:2] == ["method", "Abs Rel (scale) ↓"]
    assert rows[1][:2] == ["LoG-VGGT", shown]


def test_two_runs_do_not_share_a_folder(
    small_config: ModelConfig, small_variables: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one is told before it has read gigabytes of parameters."""
    save_model(tmp_path / "model", small_config, small_variables["params"], Provenance("windows", 42))
    values, output = configuration("rooms", {"methods": ("windows",)}), tmp_path / "out"
    monkeypatch.setattr(Checkpoint, "load", lambda path: pytest.fail("parameters are read"))
    lock = FolderLock(output, "")
    with pytest.raises(InputError, match=r"out: another run is using this folder .*choose another output"):
        run_evaluation(values, tmp_path / "model", output, command="command")
    lock.release()
    # What a run leaves that ended before it wrote anything is no hindrance.
    with pytest.raises(InputError, match="no-model"):
        run_evaluation(values, tmp_path / "no-model", output, command="command")


def test_weights_in_methods_that_are_not_theirs_are_warned_of_once(
    small_config: ModelConfig, small_variables: dict[str, Any]
) -> None:
    """Beside the weights' own method plain VGGT is a reference, whose line in the report says it."""
    checkpoint = Checkpoint(LogVGGT(small_config), small_variables, "digest")
    with pytest.warns(UserWarning, match=r"trained for windows, not for causal, pruned: expect worse") as caught:
        run_module._warn_of_unsuited("windows", ("windows", "causal", "offline", "pruned"))
    assert len(caught) == 1
    for methods, unsuited in ((("windows", "offline", "merged"), "merged"), (("offline", "chunks"), "offline, chunks")):
        with pytest.warns(UserWarning, match=f"not for {unsuited}: expect worse") as caught:
            run_module._warn_of_unsuited("windows", methods)
        assert len(caught) == 1
    run_module._warn_of_unsuited("windows", ("windows", "offline", "chunks"))
    run_module._warn_of_unsuited(None, ("causal",))
    assert "as they have never seen it" in run_module._row("causal", checkpoint, None, "windows").knows
    assert run_module._row("causal", checkpoint, None, "causal").knows.startswith("its training; each frame sees")


def test_a_folder_that_cannot_be_written_to_is_told_before_the_checkpoint_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path / "out")
    with pytest.raises(DiskError, match=r"out/clips\.jsonl: no permission to write in .*out; choose another output"):
        run_evaluation(configuration("rooms", {}), tmp_path / "no-model", tmp_path / "out", command="command")


def test_only_a_new_folder_or_an_evaluations_is_written_to(tmp_path: Path) -> None:
    values, output = configuration("rooms", {}), tmp_path / "out"
    output.mkdir()
    (output / "results.json").write_text("another program's")
    with pytest.raises(OutputExists, match=r"out is not overwritten: it holds no clips\.jsonl"):
        run_evaluation(values, tmp_path / "no-model", output, command="command")
    assert [path.name for path in output.iterdir()] == ["results.json"]
    (output / "clips.jsonl").touch()
    with pytest.raises(InputError, match="no-model"):
        run_evaluation(values, tmp_path / "no-model", output, command="command")
