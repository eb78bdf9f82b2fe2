"""Timings of whole sequences: what is run, what is kept, what cannot be run; how fast is no test's business."""

import copy
import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.evaluation.costs import streams, throughput
from logvggt_jax.evaluation.costs.parts import PARTS, time_part
from logvggt_jax.evaluation.costs.streams import TimingConfig, random_pictures, time_stream
from logvggt_jax.evaluation.costs.throughput import measured_timings
from logvggt_jax.evaluation.methods.method import Checkpoint, model_row
from logvggt_jax.streaming import OfflineSettings, StreamSession


def test_every_row_is_timed_once_and_kept(
    small_config: ModelConfig, small_variables: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(throughput, "time_part", functools.partial(time_part, least_seconds=0.0))
    checkpoint = Checkpoint(LogVGGT(small_config), small_variables, "digest")
    references = [model_row("offline", checkpoint, OfflineSettings(max_frames=5))]
    config = TimingConfig(lengths=(7, 5), rounds=2)

    def measure(checkpoint: Checkpoint = checkpoint, *, longer_edge: int = 42, fresh: bool = False) -> dict[str, Any]:
        return measured_timings(checkpoint, references, config, tmp_path, longer_edge=longer_edge, fresh=fresh)

    report = measure()
    assert report["image_size"] == [28, 42] and report["lengths"] == [5, 7] and report["part_frames"] == 7
    rates = copy.deepcopy(report["frames_per_second"])
    modes = ["full, trunk all", "full, trunk 4", "GCCR online, trunk all", "GCCR online, trunk 4"]
    assert list(rates) == [*modes, "VGGT offline"]
    assert "exceeds max_frames=5" in rates["VGGT offline"].pop("7")
    for by_length in rates.values():
        assert set(by_length) <= {"5", "7"}
        assert all(len(values) == 2 and min(values) > 0 for values in by_length.values())
    assert [part["name"] for part in report["parts"]] == list(PARTS)
    assert all(part["seconds"] > 0 for part in report["parts"])
    assert json.loads((tmp_path / "timings.json").read_text()) == report

    def again(*_: object, **__: object) -> None:
        raise AssertionError("measured again")

    with monkeypatch.context() as patch:
        patch.setattr(streams, "time_stream", again)
        assert measure() == report
        others = dataclasses.replace(checkpoint, digest="others")
        for changed in ({"longer_edge": 56}, {"checkpoint": others}, {"fresh": True}):
            with pytest.raises(AssertionError, match="measured again"):
                measure(**changed)
        (tmp_path / "timings.json").write_text("{")
        with pytest.raises(AssertionError, match="measured again"):
            measure()


def test_a_stream_is_timed_from_its_first_frame_to_its_cameras(
    small_config: ModelConfig, small_variables: dict[str, Any]
) -> None:
    run = time_stream(StreamSession(LogVGGT(small_config), small_variables), random_pictures((28, 42)), 9, watch=True)
    assert 0 < run.first_result < run.seconds and run.live_bytes > 0
    # Windows end with frames 4, 6 and 8, and a stream may be one ahead of what it hands out.
    assert 2 <= len(run.steps) <= 3 and sum(run.steps) < run.seconds
