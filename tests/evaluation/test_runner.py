"""Whole evaluations of small rooms with methods whose results are known beforehand."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import pytest
from known_answers import SIZE, all_frames, benchmarks_of, failing, oracle, run

from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.baselines import static_camera
from logvggt_jax.evaluation.methods.method import ClipPrediction
from logvggt_jax.evaluation.plan import Clip, plan_clips
from logvggt_jax.evaluation.protocols.clips import ClipSettings
from logvggt_jax.evaluation.report.report import tables, write_report
from logvggt_jax.streaming import PredictionError
from logvggt_jax.types import Frames


def test_the_truth_in_another_world_and_unit_is_perfect(rooms: Rooms, tmp_path: Path) -> None:
    results = run(rooms, [oracle(all_frames(rooms)), static_camera()], tmp_path)
    assert not results["skipped"] and not results["failures"]
    perfect = [entry for entry in results["summary"] if entry["method"] == "oracle"]
    assert [entry["frames"] for entry in perfect] == [4, 6]
    for entry in perfect:
        for alignment in ("scale", "median"):
            assert entry[f"{alignment}/abs_rel"] < 1e-6 and entry[f"{alignment}/delta_1.25"] == 1.0
        assert entry["ate"] < 1e-5 and entry["rotation_error"] < 1e-3
        assert entry["rra@5"] == entry["rta@30"] == 1.0 and entry["acc_mean"] < 1e-5
        assert entry["comp_mean"] < 1e-5 and entry["nc_mean"] > 0.999
        assert entry["clips_depth"] == entry["clips_points"] == entry["clips"] == 2
    for entry in (entry for entry in results["summary"] if entry["method"] == "static camera"):
        assert entry["ate_ratio"] == 1.0 and entry["rotation_ratio"] == pytest.approx(1.0)
        assert entry["auc@30"] == entry["rta@30"] == 0.0 and "acc_mean" not in entry
        assert "scale/abs_rel" not in entry


def test_results_are_written_as_json_and_the_same_twice(rooms: Rooms, tmp_path: Path) -> None:
    methods = [oracle(all_frames(rooms)), static_camera()]
    first = run(rooms, methods, tmp_path / "a")
    run(rooms, methods, tmp_path / "b")
    for name in ("results.json", "clips.jsonl"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert json.loads((tmp_path / "a" / "results.json").read_text()) == json.loads(json.dumps(first))
    lines = [json.loads(line) for line in (tmp_path / "a" / "clips.jsonl").read_text().splitlines()]
    assert set(lines[0]) == {"environment"} and len(lines) == 1 + 2 * 2 * 2
    assert lines[1]["indices"] == [0, 2, 4, 6]


def test_predictions_that_are_not_finite_are_counted_not_averaged(rooms: Rooms, tmp_path: Path) -> None:
    def spoil(prediction: ClipPrediction) -> ClipPrediction:
        depth, extrinsics = np.array(prediction.depth), np.array(prediction.extrinsics)
        if len(depth) == 4:
            depth[2, 0, 0] = np.nan
            extrinsics[1, 0, 3] = np.inf
        return prediction._replace(depth=depth, extrinsics=extrinsics)

    results = run(rooms, [oracle(all_frames(rooms), spoil)], tmp_path)
    spoiled, whole = results["summary"]
    assert spoiled["clips"] == 2
    assert [spoiled[f"clips_{group}"] for group in ("depth", "pose", "trajectory", "points")] == [0, 0, 0, 0]
    assert "ate" not in spoiled and whole["clips_depth"] == whole["clips_pose"] == 2
    reasons = {failure["metric"]: failure["reason"] for failure in results["failures"]}
    assert "depth of frame 2 is not finite" in reasons["depth"]
    assert "pose of frame 1 is not finite" in reasons["pose"]
    write_report(results, tmp_path)
    assert "not measurable: depth of oracle, 4 frames, 2 clip(s)" in (tmp_path / "report.md").read_text()


def test_a_prediction_that_stands_still_has_no_trajectory_error(rooms: Rooms, tmp_path: Path) -> None:
    def freeze(prediction: ClipPrediction) -> ClipPrediction:
        return prediction._replace(extrinsics=np.tile(np.eye(4), (len(prediction.extrinsics), 1, 1)))

    results = run(rooms, [oracle(all_frames(rooms), freeze)], tmp_path)
    assert {failure["metric"] for failure in results["failures"]} == {"trajectory"}
    assert all("ate" not in entry and entry["clips_trajectory"] == 0 for entry in results["summary"])
    title, header, rows, _ = tables(results)[1]
    assert title == "Pose, clips of 4 frames"
    assert rows[0][header.index("ATE (m) ↓")] == "-"
    assert rows[0][-1] == "pose 2/2, trajectory 0/2"


class Broken:
    """Two rooms of which one cannot be read."""

    def __init__(self, rooms: Rooms) -> None:
        self.rooms, self.sequences, self.identity = rooms, rooms.sequences, rooms.identity

    def num_frames(self, sequence: str) -> int:
        return self.rooms.num_frames(sequence)

    def frame_names(self, sequence: str) -> list[str]:
        return list(self.rooms.frame_names(sequence))

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        if sequence == self.sequences[1]:
            raise OSError("frame-000003.color.png is truncated")
        return self.rooms.read(sequence, indices)

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> None:
        return None

    def content_digest(self, sequence: str) -> str:
        return self.rooms.content_digest(sequence)


def test_clips_that_cannot_be_read_are_listed_and_counted(rooms: Rooms, tmp_path: Path) -> None:
    config = ClipSettings(image_size=SIZE, clip_lengths=(4, 40), figures=0)
    results = run(Broken(rooms), [static_camera()], tmp_path, config)
    reasons = [(entry["frames"], entry["reason"]) for entry in results["skipped"]]
    assert (4, "frame-000003.color.png is truncated") in reasons
    assert sum(frames == 40 and "has 16 frames" in why for frames, why in reasons) == 2
    (entry,) = results["summary"]
    assert (entry["clips_pose"], entry["clips"]) == (1, 2)
    assert tables(results)[0].rows[0][-1] == "1/2"


def test_an_evaluation_of_nothing_is_an_error(rooms: Rooms, tmp_path: Path) -> None:
    config = ClipSettings(image_size=SIZE, clip_lengths=(50,))
    with pytest.raises(InputError, match="no clip could be evaluated"):
        run(rooms, [static_camera()], tmp_path / "out", config)
    assert list(tmp_path.iterdir()) == []


def test_methods_of_one_name_are_refused(rooms: Rooms, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unique names"):
        run(rooms, [static_camera(), static_camera()], tmp_path)


def test_clips_are_evenly_spaced(rooms: Rooms) -> None:
    config = ClipSettings(image_size=SIZE, clip_lengths=(4,), stride=2, clips_per_sequence=3, max_sequences=1)
    benchmarks = benchmarks_of(rooms, config)
    clips, skipped = plan_clips(benchmarks, 1)
    assert not skipped
    assert [clip.indices for clip in clips] == [(0, 2, 4, 6), (4, 6, 8, 10), (9, 11, 13, 15)]
    assert clips[0] == Clip(benchmarks[0], rooms.sequences[0], (0, 2, 4, 6))


@pytest.mark.parametrize(
    ("error", "message"), [(PredictionError, "needs fewer frames"), (MemoryError, "out of memory")]
)
def test_a_method_that_fails_on_a_clip_is_counted_and_tried_again(
    rooms: Rooms, tmp_path: Path, error: type[Exception], message: str
) -> None:
    method, calls = failing(message, at_call=1, error=error)
    results = run(rooms, [method], tmp_path)
    assert [(failure["metric"], failure["reason"]) for failure in results["failures"]] == [("prediction", message)]
    first, second = results["summary"]
    assert (first["clips_pose"], first["clips_measured"], first["clips"]) == (1, 1, 2)
    assert second["clips_pose"] == 2
    again = run(rooms, [method], tmp_path)
    assert not again["failures"] and len(calls) == 5


def test_a_method_that_fails_everywhere_is_an_error(rooms: Rooms, tmp_path: Path) -> None:
    def refuse(images: np.ndarray) -> ClipPrediction:
        raise PredictionError("images must be multiples of 16")

    with pytest.raises(InputError, match="no method could predict any clip; the first says: images must be"):
        run(rooms, [dataclasses.replace(static_camera(), predict=refuse)], tmp_path)


def test_only_an_exhausted_device_counts_as_out_of_memory(rooms: Rooms, tmp_path: Path) -> None:
    method, _ = failing("RESOURCE_EXHAUSTED: Out of memory allocating", at_call=1, error=jax.errors.JaxRuntimeError)
    assert "out of memory on the device" in run(rooms, [method], tmp_path / "a")["failures"][0]["reason"]
    method, _ = failing("INTERNAL: broken", at_call=1, error=jax.errors.JaxRuntimeError)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        run(rooms, [method], tmp_path / "b")


def test_a_bug_in_a_method_is_not_called_unmeasurable(rooms: Rooms, tmp_path: Path) -> None:
    method, _ = failing("shapes do not match", at_call=1, error=ValueError)
    with pytest.raises(ValueError, match="shapes do not match"):
        run(rooms, [method], tmp_path)


def test_sets_of_sequences_give_a_spread(rooms: Rooms, tmp_path: Path) -> None:
    """Two rooms in two sets: beside a mean stands what the two values of two rooms say of it."""
    settings = ClipSettings(image_size=SIZE, clip_lengths=(4,), sets=2, max_points=500, figures=0)
    results = run(rooms, [static_camera()], tmp_path, settings)
    (entry,) = results["summary"]
    lines = [json.loads(line) for line in (tmp_path / "clips.jsonl").read_text().splitlines()]
    single = [line["metrics"]["ate"] for line in lines if "metrics" in line]
    assert len(single) == 2 and entry["ate"] == pytest.approx(np.mean(single))
    assert entry["spread"]["ate"] == pytest.approx(np.std(single, ddof=1)) and entry["spread"]["ate"] > 0
    pose = next(table for table in tables(results) if table.title.startswith("Pose"))
    assert f"{entry['ate']:.4f} ± {entry['spread']['ate']:.4f}" in pose.rows[0][1]


def test_without_sets_a_mean_stands_alone(rooms: Rooms, tmp_path: Path) -> None:
    results = run(rooms, [static_camera()], tmp_path)
    assert all("spread" not in entry for entry in results["summary"])
    assert not any("±" in cell for table in tables(results) for row in table.rows for cell in row)
