"""The command line: help, exit codes, one-line errors, and the whole way from a room to a point cloud."""

from __future__ import annotations

import functools
import inspect
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from result_folder import write_result

from logvggt_jax import ModelConfig
from logvggt_jax.cli import main
from logvggt_jax.cli.choices import FORMATS, METHOD_NAMES
from logvggt_jax.cli.program import command_parser
from logvggt_jax.compile import default_cache_folder, enable_compilation_cache
from logvggt_jax.data import DATASETS
from logvggt_jax.data.packed.pack import pack
from logvggt_jax.errors import DiskError
from logvggt_jax.operations import matmul_flops_per_second
from logvggt_jax.reconstruction import EXPORTERS, Reconstruction
from logvggt_jax.reconstruction.exporters import Format
from logvggt_jax.reconstruction.fusion.rescale import rescale
from logvggt_jax.reconstruction.live import OnlineSettings
from logvggt_jax.reconstruction.points.cloud_file import read_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.reconstruct import reconstruct
from logvggt_jax.reconstruction.sources import SourceOptions
from logvggt_jax.reconstruction.viewer import open_viewer
from logvggt_jax.streaming import METHODS
from logvggt_jax.weights.checkpoints import save_model
from logvggt_jax.weights.provenance import Provenance

COMMANDS = (
    "convert",
    "reconstruct",
    "export",
    "fuse",
    "scale",
    "render-room",
    "view",
    "info",
    "data check",
    "data list",
)


@pytest.fixture(scope="module")
def checkpoint(small_config: ModelConfig, small_variables: dict, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoint") / "model"
    save_model(folder, small_config, small_variables["params"], Provenance("windows", 42, source="a test"))
    return folder


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "room"
    assert main(["render-room", "--output", str(folder), "--frames", "5", "--size", "56x84"]) == 0
    return folder


def assert_fails(capsys: pytest.CaptureFixture[str], arguments: list[str], *parts: str, code: int = 2) -> None:
    """The command exits with `code` and one line that has all `parts`."""
    assert main(arguments) == code
    error = capsys.readouterr().err.strip()
    assert error.startswith("logvggt: error: ")
    assert "\n" not in error
    for part in parts:
        assert part in error


def test_help_names_every_command_and_each_shows_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert all(command.split()[0] in text for command in COMMANDS)
    for command in COMMANDS:
        with pytest.raises(SystemExit) as exit_:
            main([*command.split(), "--help"])
        assert exit_.value.code == 0
        text = capsys.readouterr().out
        assert f"logvggt {command}" in text.split("example:")[1]
        assert "(default: [])" not in text
        assert command != "render-room" or "which room (default: 0)" in text


def test_every_method_is_a_mode_and_every_exporter_a_format() -> None:
    assert set(METHOD_NAMES) == set(METHODS)
    assert tuple(EXPORTERS) == FORMATS


def test_defaults_are_those_of_the_functions_behind() -> None:
    """The parser writes them out, since it is built before anything is imported."""

    def differing(command: str, function: Callable[..., Any], **renamed: str) -> set[str]:
        """Parameters whose default is not that of the option of this name, or of the one that it is renamed to."""
        given = vars(command_parser().parse_args(command.split()))
        parameters = inspect.signature(function).parameters.values()
        expected = {each.name: each.default for each in parameters if each.default is not each.empty}
        assert set(renamed) <= set(expected) and set(renamed.values()) <= set(given)
        known = {name: option for name in expected if (option := renamed.get(name, name)) in given}
        assert known
        return {name for name, option in known.items() if given[option] != expected[name]}

    command = "reconstruct walk.mp4 --checkpoint rooms --output walk"
    assert differing(command, PointFilter) == set()
    assert differing(command, SourceOptions) == set()
    # These follow from the checkpoint.
    assert differing(command, reconstruct, num_previews="previews") == {"method", "longer_edge"}
    assert differing("live 0 --checkpoint rooms", OnlineSettings) == set()
    assert differing("view walk", open_viewer) == set()
    assert differing("scale walk --output metres --depth sensor", rescale) == {"depth"}
    assert differing("data pack scannet scans --output shards", pack) == set()


def test_help_does_not_wait_for_jax() -> None:
    """JAX takes seconds to load; and what the package offers is there once it is asked for."""
    program = """
import contextlib, sys
from logvggt_jax.cli import main
with contextlib.suppress(SystemExit):
    main(["reconstruct", "--help"])
with contextlib.suppress(SystemExit):
    main(["data", "check", "--help"])
assert "jax" not in sys.modules
import logvggt_jax
assert all(getattr(logvggt_jax, name) is not None for name in logvggt_jax.__all__)
assert set(logvggt_jax.__all__) <= set(dir(logvggt_jax))
assert logvggt_jax.geometry.decode_poses
assert not hasattr(logvggt_jax, "LogVGTT")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["info"],
        ["info", "x", "--fast"],
        ["view", "x", "--port", "y"],
        ["data"],
        ["data", "check", "replica"],
        ["data", "check", "replica", "x", "--split", "y"],
    ],
)
def test_wrong_usage_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    said = capsys.readouterr().err
    assert re.fullmatch(r"logvggt.*: error: .*; `logvggt.* --help` tells how it is used\n", said), said


def test_module_runs_as_a_program() -> None:
    command = [sys.executable, "-m", "logvggt_jax", "info", "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "nowhere" in done.stderr
    assert done.stdout == ""


@pytest.mark.filterwarnings("ignore:.*field of view")  # the model is not trained
def test_from_a_room_to_a_point_cloud_and_exports_of_which_one_fails(
    checkpoint: Path, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise DiskError("the disk is full")

    monkeypatch.setitem(EXPORTERS, "euroc", Format(fails, "euroc.csv"))
    output = tmp_path / "out"
    arguments = ["reconstruct", str(room), "--checkpoint", str(checkpoint), "--output", str(output)]
    arguments += ["--max_points=500", "--compilation-cache", "none", "--previews", "1"]
    assert_fails(capsys, [*arguments, "--intrinsics", "70,71,100,28"], "outside of images of 84 x 56 pixels")
    arguments += ["--intrinsics", "70,71,41,28"]
    exports = ("euroc", "tum", "nerfstudio", "tum")
    assert main([*arguments, *(word for name in exports for word in ("--export", name))]) == 2
    shown = capsys.readouterr()
    assert shown.err.count("the result is whole") == 1
    assert "the result is whole, its export euroc is not: the disk is full" in shown.err
    assert {path.name for path in (output / "exports").iterdir()} == {"tum.txt", "nerfstudio"}
    printed = shown.out.replace("\n", "")
    for name in ("cameras.json", "trajectory.txt", "points.ply", "exports/tum.txt", "exports/nerfstudio"):
        assert (output / name).stat().st_size > 0
        assert str(output / name) in printed
    assert len(list((output / "depth").glob("*.npz"))) == 5
    assert_fails(capsys, arguments, str(output), "--overwrite")
    known = [[70, 0, 41], [0, 71, 28], [0, 0, 1]]
    result = Reconstruction.open(output)
    np.testing.assert_allclose(result.intrinsics, np.tile(known, (5, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(result.depth_intrinsics[:, (0, 1), (0, 1)], np.tile([35, 35.5], (5, 1)), atol=1e-9)
    # The pictures are those of the source, at their own size.
    assert cv2.imread(str(next((output / "exports" / "nerfstudio" / "images").iterdir()))).shape == (56, 84, 3)
    export = ["export", str(output), "--format", "kitti", "--format", "ply", "--max-points", "50"]
    assert main([*export, "--output", str(tmp_path / "exported")]) == 0
    assert len(read_points(tmp_path / "exported" / "points.ply")[0]) == 50
    assert_fails(capsys, [*export, "--output", str(tmp_path / "exported")], "kitti.txt exists", "--overwrite")
    (output / "cameras.json").write_text('{"format": "logvggt-cameras-9"}')
    assert_fails(capsys, ["export", str(output), "--format", "tum"], "cameras.json", "'logvggt-cameras-9'")


@pytest.mark.filterwarnings("ignore:.*field of view", "always:these weights are")
def test_public_weights_run_in_chunks_unless_told_otherwise(
    small_config: ModelConfig, small_variables: dict, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_model(tmp_path / "vggt", small_config, small_variables["params"], Provenance("vggt", 42))
    arguments = ["reconstruct", str(room), "--checkpoint", str(tmp_path / "vggt"), "--output", str(tmp_path / "out")]
    arguments += ["--compilation-cache", "none", "--previews", "0", "--max-frames", "4"]
    # Only chunks take a size.
    assert main([*arguments, "--chunk-size", "4", "--loops"]) == 0
    printed = capsys.readouterr()
    assert "warning" not in printed.err
    assert "loops closed: 0" in printed.out
    assert main([*arguments, "--method", "windows", "--overwrite"]) == 0
    assert "logvggt: warning: these weights are public VGGT's, which never learned" in capsys.readouterr().err
    assert main([*arguments, "--method", "rolling", "--overwrite"]) == 0
    assert "rolling shows a frame earlier ones alone" in capsys.readouterr().err


def test_a_dry_run_says_what_a_run_needs_and_leaves_nothing(
    checkpoint: Path, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("logvggt_jax.weights.checkpoints.load_model", lambda _: pytest.fail("reads the weights"))
    # Small products say enough of the rate here.
    rate = functools.partial(matmul_flops_per_second, size=256)
    monkeypatch.setattr("logvggt_jax.reconstruction.request.matmul_flops_per_second", rate)
    arguments = ["reconstruct", str(room), "--checkpoint", str(checkpoint), "--output", str(tmp_path / "out")]
    assert main([*arguments, "--dry-run", "--compilation-cache", "none"]) == 0
    shown = capsys.readouterr()
    for part in ("5 frames of 84x56 pixels, 42x28 for the model; method windows", "disk: about", "device (", "time:"):
        assert part in shown.out
    assert shown.err == "" and list(tmp_path.iterdir()) == []


def test_eight_bits_are_announced_before_the_weights_are_read(
    checkpoint: Path, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("qwix", reason="qwix is not installed (extra `lowprecision`)")
    monkeypatch.setattr("logvggt_jax.weights.checkpoints.load_model", lambda _: pytest.fail("reads the weights"))
    monkeypatch.setattr("logvggt_jax.reconstruction.request.describe", lambda *_: [])
    arguments = ["reconstruct", str(room), "--checkpoint", str(checkpoint), "--output", str(tmp_path / "out")]
    arguments += ["--dry-run", "--compilation-cache", "none", "--precision", "int8"]
    assert main(arguments) == 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and "int8" in said[0] and "(cpu)" in said[0] and "without --precision" in said[1]
    monkeypatch.setitem(sys.modules, "qwix", None)
    assert_fails(capsys, arguments, "qwix", 'pip install "logvggt-jax[lowprecision]"')


def test_a_page_that_cannot_be_served_is_refused_before_the_model(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="extra `viewer` is not installed")
    absent = str(tmp_path / "no-model")
    arguments = ["reconstruct", str(room), "--checkpoint", absent, "--output", str(tmp_path / "out"), "--dry-run"]
    assert_fails(capsys, [*arguments, "--port", "7000"], "where the viewer's page is served: give --view, too")
    assert_fails(capsys, [*arguments, "--view"], "no-model")
    assert_fails(capsys, [*arguments, "--view", "--port", "70000"], "port must be 1 to 65535, got 70000")
    assert_fails(capsys, [*arguments, "--view", "--host", "203.0.113.7"], "cannot be served at '203.0.113.7'")
    monkeypatch.setitem(sys.modules, "viser", None)
    assert_fails(capsys, [*arguments, "--view"], "viser", 'pip install "logvggt-jax[viewer]"')
    live = ["live", "0", "--checkpoint", absent, "--view"]
    monkeypatch.setattr(
        "logvggt_jax.reconstruction.sources.open_source", lambda *_, **__: SimpleNamespace(address=None)
    )
    assert_fails(capsys, live, "viser", 'pip install "logvggt-jax[viewer]"')


def test_info_counts_parameters(checkpoint: Path, small_variables: dict, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(checkpoint)]) == 0
    total = sum(leaf.size for leaf in jax.tree.leaves(small_variables))
    text = capsys.readouterr().out
    assert f"{total:,}" in text
    for part in ("encoder", "aggregator", "camera_head", "depth_head", "gccr"):
        assert part in text
    assert "trained for: windows" in text and "longer edge 42 pixels" in text and "source: a test" in text
    assert "licence: not recorded" in text


def test_info_takes_a_training_runs_folder_and_suggests_the_right_spelling(
    checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(checkpoint.parent)]) == 0
    assert "every parameter is finite" in capsys.readouterr().out
    assert_fails(capsys, ["info", str(checkpoint.with_name("modle"))], f"did you mean {checkpoint}?")
    assert_fails(capsys, ["info", str(checkpoint / "config.json")], "is a file and no model folder")


def test_convert_never_replaces_a_folder_unasked(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_fails(capsys, ["convert", "absent.pt", "--output", str(checkpoint)], str(checkpoint), "--overwrite")
    (tmp_path / "notes.txt").touch()
    asked = ["convert", "absent.pt", "--output", str(tmp_path), "--overwrite"]
    assert_fails(capsys, asked, "is not overwritten", str(tmp_path))
    # Where it may be replaced, the source is looked at next.
    assert_fails(
        capsys, ["convert", "absent.pt", "--output", str(checkpoint), "--overwrite"], "absent.pt: no such file"
    )


@pytest.mark.filterwarnings("ignore:these weights were trained on windows")
def test_bad_input_is_one_line_and_exit_code_2(
    checkpoint: Path, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    output = tmp_path / "out"

    def reconstruct(source: Path, model: Path = checkpoint, *options: str) -> list[str]:
        command = ["reconstruct", str(source), "--checkpoint", str(model), "--output", str(output)]
        return [*command, "--compilation-cache", "none", "--longer-edge", "42", *options]

    assert_fails(capsys, reconstruct(empty), "no image in", str(empty))
    assert_fails(capsys, reconstruct(tmp_path / "nothing"), "does not exist")
    # The source is looked at before the model, which may take minutes to load.
    assert_fails(capsys, reconstruct(empty, tmp_path / "no-model"), "no image in")
    assert_fails(capsys, reconstruct(room, empty), str(empty))
    # So are sizes.
    assert_fails(capsys, reconstruct(room, tmp_path / "no-model", "--longer-edge", "50"), "longer_edge", "14", "50")
    assert_fails(capsys, reconstruct(room, checkpoint, "--confidence-percentile", "120"), "confidence_percentile")
    assert_fails(capsys, reconstruct(room, checkpoint, "--stride", "0"), "stride")
    assert_fails(capsys, reconstruct(room, checkpoint, "--chunk-size", "8"), "--chunk-size needs --method chunks")
    chunks = ("--mode", "chunks", "--chunk-size", "8", "--chunk-overlap", "30")
    assert_fails(capsys, reconstruct(room, checkpoint, *chunks), "chunk overlap must be", "8, got 30")
    both = ("--mode", "chunks", "--chunk-size", "8", "--setting", "overlap=2")
    assert_fails(capsys, reconstruct(room, checkpoint, *both), "--chunk-size needs --method chunks without --setting")
    for method, setting, words in (
        ("pruned", "cap", ("expected NAME=VALUE",)),
        ("pruned", "caps=9", ("unknown field pruned.caps", "did you mean cap")),
        ("pruned", "bits=8", ("pruned.bits must be one of 4, 16, got 8",)),
        ("causal", "camera_cache=both", ("causal.camera_cache must be one of 'per_round', 'single'",)),
        ("rolling", "budget=9", ("budget", "fewer than", "take at least")),
        ("pruned", "cap=9", ("cap", "fewer than", "take at least")),
    ):
        given = ("--method", method, "--setting", setting)
        assert_fails(capsys, reconstruct(room, checkpoint, *given), *words)
    masks = ("--masks", str(empty))
    assert_fails(capsys, reconstruct(room, tmp_path / "no-model", *masks), "no mask in", str(empty))
    masks = ("--masks", str(next(room.glob("*.color.png"))), "--method", "causal")
    assert_fails(capsys, reconstruct(room, checkpoint, *masks), "--method causal takes no masks")
    loops = ("--mode", "offline", "--loops")
    assert_fails(capsys, reconstruct(room, checkpoint, *loops), "--loops needs --method chunks or windows, not offline")
    truncated = tmp_path / "truncated"
    truncated.mkdir()
    for file in sorted(room.glob("*.color.png"))[:2]:
        (truncated / file.name).write_bytes(file.read_bytes())
    (truncated / file.name).write_bytes(file.read_bytes()[:300])
    assert_fails(capsys, reconstruct(truncated, checkpoint, "--strict"), file.name)
    assert_fails(capsys, ["convert", str(empty), "--output", str(output)], str(empty))
    assert_fails(capsys, ["view", str(empty)], str(empty))
    assert_fails(capsys, ["render-room", "--output", str(room)], str(room), "--overwrite")
    assert_fails(capsys, ["render-room", "--output", str(output), "--frames", "0"], "num_frames")
    vast = ["render-room", "--output", str(output), "--size", "99999x99999"]
    assert_fails(capsys, vast, "99999x99999", "at most 16,777,216 pixels")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "truncated"]


def test_data_check_tells_clean_from_damaged_copies(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A rendered room has the names of 7-Scenes; its depth and colour camera are one, so only files are judged here.
    root = tmp_path / "7scenes"
    shutil.copytree(room, root / "den" / "seq-01")
    picture = tmp_path / "check.png"
    command = ["data", "check", "seven_scenes", str(root)]
    assert main([*command, "--all-images", "--output", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "den/seq-01: 5 frames" in printed and "problems: none" in printed
    assert picture.stat().st_size > 0
    assert main([*command, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == report["decoded"] == 5 and report["problem_counts"] == {}
    (root / "den" / "seq-01" / "frame-000002.depth.proj.png").unlink()
    (root / "den" / "seq-01" / "frame-000003.color.png").unlink()
    assert main(command) == 1
    printed = capsys.readouterr().out
    assert "problems: 2 missing file" in printed
    assert "frame-000002.depth.png: no such file" in printed and "frame-000003.color.png: no such file" in printed
    assert main([*command, "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["problem_counts"] == {"missing file": 2}
    assert_fails(capsys, ["data", "check", "seven", str(root)], "'seven'", "seven_scenes")
    assert_fails(capsys, ["data", "check", "rooms", str(root)], "rooms")
    assert_fails(capsys, ["data", "check", "seven_scenes", str(tmp_path / "x")], str(tmp_path / "x"))
    assert_fails(capsys, [*command, "--max-sequences", "0"], "max_sequences", "0")


def test_data_list_names_every_set(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "list"]) == 0
    printed = capsys.readouterr().out
    for name in DATASETS:
        assert f"\n{name}: " in f"\n{printed}"
    assert "never unpacked" in " ".join(printed.split())


def test_traceback_only_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(tmp_path / "x")]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert main(["info", str(tmp_path / "x"), "--traceback"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_a_fault_of_our_own_keeps_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only InputError becomes a line: a ValueError is a bug, whatever it says, and is left to the interpreter."""

    def load_model(path: object) -> None:
        raise ValueError("operands could not be broadcast")

    monkeypatch.setattr("logvggt_jax.weights.checkpoints.load_model", load_model)
    with pytest.raises(ValueError, match="operands could not be broadcast"):
        main(["info", "x"])
    assert capsys.readouterr() == ("", "")


def test_what_the_disk_refuses_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert_fails(capsys, ["render-room", "--output", str(tmp_path / "file" / "room")], "file/room", "Not a directory")


def test_compilation_cache_follows_flag_environment_and_user_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ("jax_compilation_cache_dir", "jax_enable_compilation_cache")
    before = {name: getattr(jax.config, name) for name in settings}
    try:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        assert default_cache_folder() == tmp_path / "logvggt" / "xla"
        assert enable_compilation_cache() == default_cache_folder()
        assert jax.config.jax_compilation_cache_dir == str(default_cache_folder())
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "jax"))
        assert enable_compilation_cache() == tmp_path / "jax"
        assert enable_compilation_cache(str(tmp_path / "flag")) == tmp_path / "flag"
        assert enable_compilation_cache("none") is None
        assert not jax.config.jax_enable_compilation_cache
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_view_saves_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "result").mkdir()
    write_result(tmp_path / "result")
    page = str(tmp_path / "page.html")
    assert main(["view", str(tmp_path / "result"), "--save", page]) == 0
    assert "10 of 10 points" in capsys.readouterr().out and Path(page).stat().st_size < 25_000_000
    assert main(["view", str(tmp_path / "result"), "--save", page]) == 2
    assert "page.html exists: choose another name or pass --overwrite" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "result"), "--save", page, "--overwrite", "--host", "0.0.0.0"]) == 2
    assert "with --save it is a file, leave them out" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "result"), "--save", page, "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["reconstruct", "walk", "--output", "", "--checkpoint", "rooms"], "argument --output: the path is empty"),
        (["export", "", "--format", "ply"], "argument result: the path is empty"),
        (["info", "rooms", "n" * 300], "unrecognized arguments: nnn"),
        (["reconstruct", "1.jpg", "2.jpg", "--output", "o", "--checkpoint", "rooms"], r"put a pattern in quotes"),
        (["view", "1.jpg", "2.jpg"], "unrecognized arguments: 2.jpg; `logvggt --help`"),
        (
            ["reconstruct", "1.jpg", "3.jpg", "--output", "o", "--checkpoint", "rooms"],
            "unrecognized arguments: 3.jpg; `logvggt --help`",
        ),
    ],
)
def test_slips_of_the_shell_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("1.jpg", "2.jpg"):
        (tmp_path / name).touch()
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.parametrize("given", ["", "~nobody-of-this-name/model"])
def test_a_checkpoint_that_is_no_path_is_one_line(given: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["info", given]) == 2
    error = capsys.readouterr().err
    assert error.startswith("logvggt: error: ") and error.count("\n") == 1
