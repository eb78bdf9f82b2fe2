"""The paper's tables: every number of the paper once, ours below, incomplete means marked."""

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from logvggt_jax.evaluation.protocols import ProtocolSettings, paper_protocols
from logvggt_jax.evaluation.report.paper_tables import THIS_RUN, paper_results, paper_tables


def results(summary: list[dict[str, Any]], methods: tuple[str, ...] = ("ours",)) -> dict[str, Any]:
    benchmarks = [
        {"name": p.name, "expected": p.expected, "planned": sum(e["benchmark"] == p.name for e in summary)}
        for p in paper_protocols(ProtocolSettings())
    ]
    return {"methods": [{"name": name} for name in methods], "benchmarks": benchmarks, "summary": summary}


def numbers(tree: Any) -> Iterator[float]:
    if isinstance(tree, dict):
        for value in tree.values():
            yield from numbers(value)
    elif isinstance(tree, int | float) and not isinstance(tree, bool):
        yield float(tree)


def test_every_number_of_the_paper_is_shown_once() -> None:
    shown = Counter(
        float(text)
        for table in paper_tables(results([]))
        for row in table.rows
        if not row[0].startswith(THIS_RUN)
        for cell in row[1:]
        for text in re.findall(r"\d+(?:\.\d+)?", cell.replace(",", ""))
        if "." in cell or "," in cell or cell == "134"
    )
    stored = Counter(number for table in paper_results().values() for number in numbers(table["data"]))
    assert shown == stored


def test_the_packages_copy_equals_the_papers_source(golden_dir: Path) -> None:
    path = golden_dir.parent / "spec" / "paper_results.json"
    if not path.exists():
        pytest.skip("the machine-readable tables are not beside the golden data")
    source = json.loads(path.read_text())["tables"]
    copy = paper_results()
    assert {name: table["data"] for name, table in source.items()} == {n: t["data"] for n, t in copy.items()}


def test_every_column_names_a_benchmark_that_exists() -> None:
    from logvggt_jax.evaluation.report import paper_tables as module

    columns = [*module._clouds("200"), *module._video_depth(), *module._longer_depth("500"), *module._poses()]
    columns += [c for n in ("10", "200") for c in module._ablation(n)]
    known = {protocol.name: protocol for protocol in paper_protocols(ProtocolSettings())}
    for column in columns:
        protocol = known[column.benchmark]
        measured = {"points": protocol.points, "depth": protocol.depth, "pose": protocol.poses}
        assert measured[column.group]


def test_our_rows_stand_in_every_group_in_the_papers_units() -> None:
    entry = {
        "benchmark": "tum-poses-500",
        "method": "ours",
        "rra@30": 0.5,
        "rta@30": 0.25,
        "auc@30": 0.125,
        "clips_pose": 8,
    }
    tables = {table.title: table for table in paper_tables(results([entry] * 8, ("ours", "baseline")))}
    pose = tables["Camera pose (Table 3), percent"]
    ours = next(row for row in pose.rows if row[0] == "this run: ours")
    assert ours[1:] == ["-"] * 3 + ["50.00", "25.00", "12.50"] + ["-"] * 3
    assert not [row for row in pose.rows if row[0] == "this run: baseline"], "it claims nothing of this table"
    reconstruction = tables["3D reconstruction (Table 1)"]
    assert [row[1] for row in reconstruction.rows if row[0] == "this run: ours"] == ["200", "500", "1000"]


def test_our_times_stand_beside_the_papers() -> None:
    setting = {"device": "a device", "dtype": "float32", "image_size": [56, 70], "windows": [4, 2], "rounds": 3}
    rates = {"100": [20.0, 22.0, 21.0], "1000": "full attention over 1000 frames exceeds max_frames=200"}
    timings = {
        **setting,
        "lengths": [50, 100, 1000],
        "frames_per_second": {"VGGT offline": {"50": [40.0], **rates}},
        "part_frames": 1000,
        "parts": [{"name": "backbone", "seconds": 3.0}, {"name": "GCCR", "seconds": 1.0}],
    }
    runtime, speed = paper_tables({**results([]), "timings": timings})[-2:]
    assert ["this run: GCCR", "1,000", "25.00 %"] in runtime.rows
    assert ["this run: total", "4,000", "100.00 %"] in runtime.rows
    assert speed.header == ["method", "100", "200", "500", "1000", "50"]
    assert speed.rows[-1] == ["this run: VGGT offline", "21.0 (20.0 to 22.0)", "-", "-", "-", "40.0 (40.0 to 40.0)"]
    assert {len(row) for row in speed.rows} == {6}
    assert any("a device, float32, 70 x 56 pixels, K = 4, stride 2" in note for note in speed.notes)
    assert any("1000 frames: full attention over 1000 frames exceeds" in note for note in speed.notes)
    untimed = paper_tables(results([]))[-1]
    assert not [row for row in untimed.rows if row[0].startswith(THIS_RUN)]
    assert any("timed nothing" in note for note in untimed.notes)


@pytest.mark.parametrize(
    ("measured", "planned", "cell"), [(18, 18, "0.040"), (17, 18, "0.040 [17/18]"), (1, 1, "0.040 [1/18]")]
)
def test_a_mean_over_part_of_a_benchmark_says_so(measured: int, planned: int, cell: str) -> None:
    name = "seven_scenes-reconstruction-200"
    entry = {"benchmark": name, "method": "ours", "acc_mean": 0.04, "clips_points": measured}
    run = results([entry])
    next(b for b in run["benchmarks"] if b["name"] == name)["planned"] = planned
    table = paper_tables(run)[0]
    row = next(row for row in table.rows if row[0] == "this run: ours")
    assert row[2] == cell
    assert any("[17/18]" in note for note in table.notes) == ("[" in cell)


def test_chamfer_is_given_both_ways_and_out_of_memory_as_in_the_paper() -> None:
    name = "nrgbd-reconstruction-10"
    entry = {"benchmark": name, "method": "ours", "chamfer_sum": 0.06, "chamfer_mean": 0.03, "clips_points": 9}
    table = next(t for t in paper_tables(results([entry] * 9)) if t.title.startswith("Ablation"))
    ours = next(row for row in table.rows if row[0] == "this run: ours")
    assert ours[table.header.index("NRGBD CD ↓")] == "0.060 / 0.030"
    assert next(row for row in table.rows if row[:2] == ["w/o CWA (paper)", "200"])[2:] == ["OOM"] * 7


def test_impossible_areas_are_marked() -> None:
    pose = next(t for t in paper_tables(results([])) if t.title.startswith("Camera pose"))
    assert sum(cell.endswith("‡") for row in pose.rows for cell in row) == 9
    assert any("no area under" in note for note in pose.notes)
