"""Tables and picture of methods as sequences grow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import pytest

from logvggt_jax.evaluation.report.by_length import length_panels, length_tables
from logvggt_jax.evaluation.report.figures import length_plot
from logvggt_jax.evaluation.report.tables import MARK


@pytest.fixture
def results() -> dict[str, Any]:
    """Two methods and a camera that stands still, at 12 and 25 frames; the second one cannot take 25."""

    def entry(method: str, frames: int, ate: float | None, abs_rel: float | None) -> dict[str, Any]:
        return {"method": method, "frames": frames, "ate": ate, "scale/abs_rel": abs_rel}

    summary = [entry("a", 12, 0.2, 0.10), entry("a", 25, 0.3, 0.20), entry("b", 12, 0.4, 0.05)]
    summary += [entry("still", 12, 0.1, None), entry("still", 25, 0.1, None)]
    costs = {
        "a": {
            "12": {"frames_per_second": [9.0, 10.0, 30.0], "state_bytes": 2_000_000, "compilations": 0},
            "25": {"frames_per_second": [8.0], "state_bytes": 4_000_000, "compilations": 2},
        },
        "b": {"12": {"frames_per_second": [20.0], "state_bytes": 500, "compilations": 0}, "25": {"reason": "too long"}},
    }
    timings = {"device": "d", "dtype": "float32", "image_size": [56, 70], "rounds": 3, "costs": costs}
    methods = [{"name": name, "static": name == "still"} for name in ("a", "b", "still")]
    return {"summary": summary, "methods": methods, "timings": timings}


def test_a_table_for_each_of_accuracy_and_cost(results: dict[str, Any]) -> None:
    ate, depth, rate, state = length_tables(results)
    assert ate.header == ["method", "12 ↓", "25 ↓"] and rate.header == ["method", "12 ↑", "25 ↑"]
    assert ate.rows == [
        ["a", "**0.2000**", "**0.3000**"],
        ["b", "0.4000", "-"],
        ["still", f"0.1000{MARK}", f"0.1000{MARK}"],
    ]
    assert depth.rows == [["a", "0.1000", "**0.2000**"], ["b", "**0.0500**", "-"]]
    assert rate.rows == [["a", "10.0", "**8.0**"], ["b", "**20.0**", "-"]]
    assert state.rows == [["a", "2.000", "**4.000**"], ["b", "**0.001**", "-"]]
    assert "Programs compiled in the timed runs: 2" in rate.notes[0]
    assert rate.notes[1:] == ("No rate of b, 25 frames: too long.",)
    assert "activations" in state.notes[0]


def test_a_run_that_timed_nothing_has_no_such_tables(results: dict[str, Any]) -> None:
    del results["timings"]
    assert length_tables(results) == []


def test_the_picture_shows_the_tables_numbers(results: dict[str, Any], tmp_path: Path) -> None:
    panels = length_panels(results)
    assert panels["State (MB)"]["a"] == [(12, 2.0), (25, 4.0)]
    assert panels["Frames a second"] == {"a": [(12, 10.0), (25, 8.0)], "b": [(12, 20.0)]}
    length_plot(tmp_path / "all.png", panels, "d", logarithmic={"State (MB)"})
    panels["ATE (m)"] = {"a": panels["ATE (m)"]["a"]}
    panels["Abs Rel (scale)"] = {}
    length_plot(tmp_path / "fewer.png", panels, "d")

    def coloured(name: str) -> int:
        picture = cv2.imread(str(tmp_path / name)).astype(int)
        return int((picture.max(-1) - picture.min(-1) > 60).sum())

    assert coloured("all.png") > coloured("fewer.png") > 100
