"""Benchmarks find their data: what is there is opened, what is missing is named."""

import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from logvggt_jax.data.readers.seven_scenes import SevenScenes
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.clips import load_clip
from logvggt_jax.evaluation.datasets import open_benchmarks
from logvggt_jax.evaluation.methods.baselines import static_camera, unit_depth
from logvggt_jax.evaluation.protocols import ProtocolSettings, chosen_protocols
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.evaluation.report.report import tables, write_report
from logvggt_jax.evaluation.runner import evaluate

SETTINGS = ProtocolSettings(longer_edge=70, max_points=500, options={"rooms": {"num_rooms": 1, "num_frames": 16}})


def write_seven_scenes(root: Path, count: int = 12, *, listed: bool = True) -> None:
    """One sequence of a procedural room in 7-Scenes' layout."""
    rooms = Rooms("test", height=96, width=128, num_frames=96, num_rooms=1)
    frames = rooms.read(rooms.sequences[0], range(0, 3 * count, 3))
    folder = root / "chess" / "seq-03"
    folder.mkdir(parents=True)
    if listed:
        (root / "chess" / "TestSplit.txt").write_text("sequence3\n")
    for t in range(count):
        stem = folder / f"frame-{t:06d}"
        cv2.imwrite(f"{stem}.color.png", frames.images[t][..., ::-1])
        cv2.imwrite(f"{stem}.depth.proj.png", np.rint(frames.depth[t] * 1000).astype(np.uint16))
        np.savetxt(f"{stem}.pose.txt", np.linalg.inv(frames.extrinsics[t].astype(np.float64)))


def test_data_sets_that_are_missing_or_broken_are_named(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "seven_scenes")
    (tmp_path / "sintel").mkdir()
    protocols = chosen_protocols(
        SETTINGS, ["seven_scenes-reconstruction-10", "sintel-depth", "nrgbd-figures", "rooms-12"]
    )
    opened = {benchmark.protocol.dataset: benchmark for benchmark in open_benchmarks(protocols, tmp_path, SETTINGS)}
    assert opened["seven_scenes"].split == "test" and isinstance(opened["rooms"].dataset, Rooms)
    assert opened["nrgbd"].missing == f"{tmp_path / 'nrgbd'}: no such folder"
    assert opened["sintel"].dataset is None
    assert opened["sintel"].missing.startswith("sintel, split all: ")


def test_without_a_list_of_test_sequences_all_are_taken_and_said_so(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "seven_scenes", listed=False)
    protocols = chosen_protocols(SETTINGS, ["seven_scenes-figures"])
    assert open_benchmarks(protocols, tmp_path, SETTINGS)[0].split == "all"


def test_no_data_set_at_all_is_an_error_and_rooms_need_none(tmp_path: Path) -> None:
    both = chosen_protocols(SETTINGS, ["sintel-depth", "rooms-12"])
    with pytest.raises(InputError, match="holds none of the data sets sintel"):
        open_benchmarks(both, tmp_path, SETTINGS)
    with pytest.raises(InputError, match="no such folder; --data_root"):
        open_benchmarks(both, tmp_path / "none", SETTINGS)
    sintel, rooms = open_benchmarks(both, None, SETTINGS)
    assert "no --data_root" in sintel.missing and rooms.dataset is not None


def test_a_paper_run_counts_what_is_missing_in_its_tables(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "data" / "seven_scenes")
    patterns = ["seven_scenes-reconstruction-*", "kitti-depth-110"]
    benchmarks = open_benchmarks(chosen_protocols(SETTINGS, patterns), tmp_path / "data", SETTINGS)
    results = evaluate(
        benchmarks,
        [unit_depth(), static_camera()],
        tmp_path / "out",
        title="The paper's",
        command="command",
        configuration={},
        figures=1,
        console=Console(file=io.StringIO()),
    )
    write_report(results, tmp_path / "out")
    made = {table.title: table for table in tables(results)}
    coverage = {row[0]: row[1:] for row in made["Benchmarks"].rows}
    assert coverage["seven_scenes-reconstruction-200"] == ["test", "1/18", "1/1", "200", "12", "incomplete"]
    assert coverage["kitti-depth-110"][-1] == "missing"
    page = (tmp_path / "out" / "report.md").read_text()
    assert "missing: 1 benchmark(s) without data" in page
    assert "stride max(1, n // 200)" in page, "decisions are printed with the results"
    assert "InfiniteVGGT (paper)" in (tmp_path / "out" / "report.html").read_text()
    written = json.loads((tmp_path / "out" / "results.json").read_text())
    assert written["benchmarks"][0]["frames_used"] == [10, 10]
    assert {entry["method"] for entry in written["summary"]} == {"static camera"}, "reconstruction has no depth table"


def test_clips_are_read_frame_by_frame_on_the_rules_pixels(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, count=3)
    dataset = SevenScenes(tmp_path)
    rule = PrincipalPointCrop(70)
    clip = load_clip(dataset, "chess/seq-03", [2, 0], rule)
    whole = rule(dataset.read("chess/seq-03", [2, 0]))
    for name in ("images", "depth", "intrinsics", "extrinsics"):
        np.testing.assert_array_equal(getattr(clip, name), getattr(whole, name))
    assert load_clip(dataset, "chess/seq-03", [0], rule, depth=False).depth is None
    assert clip.sfm_extrinsics is None


def test_structure_from_motion_poses_are_found_beside_the_scenes_own(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, count=3)
    dataset = SevenScenes(tmp_path)
    # A quarter turn about z, as qw qx qy qz.
    half = np.sqrt(0.5)
    lines = [f"seq-03/frame-{t:06d}.color.png {half} 0 0 {half} {t} 2 3 525.5" for t in (1, 0)]
    path = tmp_path / "chess" / "pgt_sfm_seq-03.txt"
    path.write_text("\n".join(lines) + "\n")
    poses = dataset.sfm_extrinsics("chess/seq-03", [0, 1, 2])
    assert poses is not None
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(poses[1], expected, atol=1e-6)
    assert np.isnan(poses[2]).all()
    path.write_text("seq-03/frame-000000.color.png 1 0 0\n")
    with pytest.raises(ValueError, match=r"pgt_sfm_seq-03\.txt, line 1: expected"):
        dataset.sfm_extrinsics("chess/seq-03", [0])
