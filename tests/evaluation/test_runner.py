"""Whole evaluations of small rooms with methods whose results are known beforehand."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from logvggt_jax.config import ModelConfig
from logvggt_jax.data.rooms import Rooms
from logvggt_jax.evaluation.baselines import all_baselines, depth_statistics, static_camera
from logvggt_jax.evaluation.methods import ClipPrediction, Method, network
from logvggt_jax.evaluation.protocols import ClipScore, clip_score, data_set_score, points_at, prepare_truth
from logvggt_jax.evaluation.report import print_report, tables, write_report
from logvggt_jax.evaluation.runner import Clip, EvaluationConfig, EvaluationRun, evaluate, plan_clips, write_text
from logvggt_jax.geometry import compose, unproject
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.types import Frames

SIZE = (28, 42)
CONFIG = EvaluationConfig(image_size=SIZE, clip_lengths=(4, 6), stride=2, max_points=1500, figures=0)


@pytest.fixture(scope="module")
def rooms() -> Rooms:
    return Rooms(split="test", height=SIZE[0], width=SIZE[1], num_frames=16, num_rooms=2)


def oracle(frames: Frames, change: Callable[[ClipPrediction], ClipPrediction] = lambda p: p) -> Method:
    """Recognises each image and answers with its truth in half the unit, in another world."""
    move = np.eye(4)
    move[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    move[:3, 3] = [3.0, -2.0, 1.0]
    known = {image.tobytes(): t for t, image in enumerate(frames.images)}

    def predict(images: np.ndarray) -> ClipPrediction:
        chosen = [known[image.tobytes()] for image in images]
        extrinsics = compose(frames.extrinsics[chosen].astype(np.float64), move)
        extrinsics[:, :3, 3] *= 0.5
        return change(ClipPrediction(0.5 * frames.depth[chosen], extrinsics, frames.intrinsics[chosen]))

    return Method("oracle", "everything", predict)


def all_frames(rooms: Rooms) -> Frames:
    parts = [rooms.read(name, range(rooms.num_frames(name))) for name in rooms.sequences]
    arrays = [np.concatenate([getattr(part, field) for part in parts]) for field in Frames._fields[:4]]
    return Frames(*arrays, metric=True)


def run(rooms: Rooms, methods: Sequence[Method], output: Path, config: EvaluationConfig = CONFIG) -> dict:
    return evaluate(
        rooms, methods, config, output, title="rooms", command="command", console=Console(file=io.StringIO())
    )


def test_the_truth_in_another_world_and_unit_is_perfect(rooms: Rooms, tmp_path: Path) -> None:
    results = run(rooms, [oracle(all_frames(rooms)), static_camera()], tmp_path)
    assert not results["skipped"]
    assert not results["failures"]
    perfect = [entry for entry in results["summary"] if entry["method"] == "oracle"]
    assert [entry["frames"] for entry in perfect] == [4, 6]
    for entry in perfect:
        for alignment in ("scale", "median"):
            assert entry[f"{alignment}/abs_rel"] < 1e-6
            assert entry[f"{alignment}/delta_1.25"] == 1.0
        assert entry["ate"] < 1e-5
        assert entry["rotation_error"] < 1e-3
        assert entry["rra@5"] == entry["rta@30"] == 1.0
        assert entry["acc_mean"] < 1e-5
        assert entry["comp_mean"] < 1e-5
        assert entry["nc_mean"] > 0.999
        assert entry["clips_depth"] == entry["clips_points"] == entry["clips"] == 2
    for entry in (entry for entry in results["summary"] if entry["method"] == "static camera"):
        assert entry["ate_ratio"] == 1.0
        assert entry["rotation_ratio"] == pytest.approx(1.0)
        assert entry["auc@30"] == entry["rta@30"] == 0.0
        assert "acc_mean" not in entry
        assert "scale/abs_rel" not in entry


def test_results_are_written_as_json_and_the_same_twice(rooms: Rooms, tmp_path: Path) -> None:
    methods = [oracle(all_frames(rooms)), static_camera()]
    first = run(rooms, methods, tmp_path / "a")
    run(rooms, methods, tmp_path / "b")
    for name in ("results.json", "clips.jsonl"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert json.loads((tmp_path / "a" / "results.json").read_text()) == json.loads(json.dumps(first))
    lines = [json.loads(line) for line in (tmp_path / "a" / "clips.jsonl").read_text().splitlines()]
    assert len(lines) == 2 * 2 * 2
    assert lines[0]["indices"] == [0, 2, 4, 6]


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
    assert "ate" not in spoiled
    assert whole["clips_depth"] == whole["clips_pose"] == 2
    reasons = {failure["metric"]: failure["reason"] for failure in results["failures"]}
    assert "depth of frame 2 is not finite" in reasons["depth"]
    assert "pose of frame 1 is not finite" in reasons["pose"]
    write_report(results, tmp_path / "report.md")
    assert "not measurable: depth of oracle, 4 frames, 2 clip(s)" in (tmp_path / "report.md").read_text()


def test_a_prediction_that_stands_still_has_no_trajectory_error(rooms: Rooms, tmp_path: Path) -> None:
    def freeze(prediction: ClipPrediction) -> ClipPrediction:
        return prediction._replace(extrinsics=np.tile(np.eye(4), (len(prediction.extrinsics), 1, 1)))

    results = run(rooms, [oracle(all_frames(rooms), freeze)], tmp_path)
    assert {failure["metric"] for failure in results["failures"]} == {"trajectory"}
    assert all("ate" not in entry and entry["clips_trajectory"] == 0 for entry in results["summary"])
    title, header, rows = tables(results)[1]
    assert title == "Pose, clips of 4 frames"
    assert rows[0][header.index("ATE (m) ↓")] == "-"
    assert rows[0][-1] == "pose 2/2, trajectory 0/2"


class Broken:
    """Two rooms of which one cannot be read."""

    def __init__(self, rooms: Rooms) -> None:
        self.rooms, self.sequences = rooms, rooms.sequences

    def num_frames(self, sequence: str) -> int:
        return self.rooms.num_frames(sequence)

    def frame_names(self, sequence: str) -> list[str]:
        return list(self.rooms.frame_names(sequence))

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        if sequence == self.sequences[1]:
            raise OSError("frame-000003.color.png is truncated")
        return self.rooms.read(sequence, indices)


def test_clips_that_cannot_be_read_are_listed(rooms: Rooms, tmp_path: Path) -> None:
    config = EvaluationConfig(image_size=SIZE, clip_lengths=(4, 40), figures=0)
    results = evaluate(
        Broken(rooms), [static_camera()], config, tmp_path, title="t", command="c", console=Console(file=io.StringIO())
    )
    reasons = [(entry["frames"], entry["reason"]) for entry in results["skipped"]]
    assert (4, "frame-000003.color.png is truncated") in reasons
    assert sum(frames == 40 and "has 16 frames" in why for frames, why in reasons) == 2
    assert [entry["clips"] for entry in results["summary"]] == [1]


def test_an_evaluation_of_nothing_is_an_error(rooms: Rooms, tmp_path: Path) -> None:
    config = EvaluationConfig(image_size=SIZE, clip_lengths=(50,))
    with pytest.raises(ValueError, match="no clip could be evaluated"):
        run(rooms, [static_camera()], tmp_path / "out", config)
    assert list(tmp_path.iterdir()) == []


def test_an_error_on_the_way_leaves_nothing_half_written(rooms: Rooms, tmp_path: Path) -> None:
    calls: list[int] = []

    def fail_at_the_third(images: np.ndarray) -> ClipPrediction:
        calls.append(len(images))
        if len(calls) == 3:
            raise RuntimeError("out of memory")
        return static_camera().predict(images)

    method = dataclasses.replace(static_camera(), predict=fail_at_the_third)
    with pytest.raises(RuntimeError, match="out of memory"):
        run(rooms, [method], tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_results_of_an_earlier_run_are_replaced_and_other_files_are_not(rooms: Rooms, tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    stale = [tmp_path / name for name in ("report.md", "results.json", "figures/room-00001_from_0_9_frames_depth.png")]
    for path in (*stale, tmp_path / "notes.txt"):
        path.write_text("old")
    run(rooms, [static_camera()], tmp_path)
    assert not stale[0].exists()
    assert stale[1].read_text() != "old"
    assert not stale[2].exists()
    assert (tmp_path / "notes.txt").read_text() == "old"


def test_clips_are_evenly_spaced(rooms: Rooms) -> None:
    config = EvaluationConfig(image_size=SIZE, clip_lengths=(4,), stride=2, clips_per_sequence=3, max_sequences=1)
    clips, skipped = plan_clips(rooms, config)
    assert not skipped
    assert [clip.indices for clip in clips] == [(0, 2, 4, 6), (4, 6, 8, 10), (9, 11, 13, 15)]
    assert clips[0] == Clip(rooms.sequences[0], (0, 2, 4, 6))


def test_points_of_chosen_pixels_equal_those_of_all(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 5, 9])
    points = unproject(*(np.asarray(x, np.float64) for x in (frames.depth, frames.intrinsics, frames.extrinsics)))
    indices = np.array([0, 17, 28 * 42 - 1, 2 * 28 * 42, 3 * 28 * 42 - 1])
    chosen = points_at(frames.depth, frames.intrinsics, frames.extrinsics, indices)
    np.testing.assert_allclose(chosen, points.reshape(-1, 3)[indices])


def test_invalid_pixels_give_no_true_points(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 3, 6])
    depth = frames.depth.copy()
    depth[1] = 0.0
    depth[:, :10] = 0.0
    truth = prepare_truth(frames._replace(depth=depth), max_points=None, seed=0)
    assert truth.indices is not None
    assert len(truth.indices) == (depth > 0).sum()
    assert (depth.ravel()[truth.indices] > 0).all()
    nothing = prepare_truth(frames._replace(depth=np.zeros_like(depth)), max_points=None, seed=0)
    score = clip_score(oracle(frames), oracle(frames).predict(frames.images), nothing)
    assert set(score.failures) == {"depth", "points"}


def test_score_weighs_depth_by_pixels_and_poses_plainly() -> None:
    def clip(value: float, pixels: float) -> ClipScore:
        names = ("abs_rel", "sq_rel", "rmse", "log_rmse", "delta_1.25", "delta_1.25^2", "delta_1.25^3")
        metrics = {f"{alignment}/{name}": value for alignment in ("scale", "median") for name in names}
        poses = dict.fromkeys(("rra@5", "rra@30", "rta@30", "auc@30"), value)
        rotation = {"rotation_error": value, "identity_rotation_error": 2.0}
        return ClipScore({**metrics, "valid_pixels": pixels, **poses, **rotation}, {})

    score = data_set_score([clip(0.1, 300), clip(0.5, 100)])
    assert score["scale/abs_rel"] == pytest.approx(0.2)
    assert score["auc@30"] == pytest.approx(0.3)
    assert score["rotation_ratio"] == pytest.approx(0.15)
    assert score["clips_points"] == 0


def test_depth_baselines_know_the_mean_of_what_they_were_given(rooms: Rooms) -> None:
    statistics = depth_statistics(rooms, SIZE, source="these rooms", max_frames=6)
    depth = np.concatenate([rooms.read(name, [0, 8, 15]).depth for name in rooms.sequences])
    assert statistics.mean_depth == pytest.approx(depth.mean(), rel=1e-5)
    np.testing.assert_allclose(statistics.mean_map, depth.mean(0), rtol=1e-5)


def test_the_network_and_all_baselines_make_a_table(
    rooms: Rooms, small_config: ModelConfig, small_variables: dict, tmp_path: Path
) -> None:
    model = LogVGGT(small_config)
    methods = [network(model, small_variables), *all_baselines(model, rooms, SIZE, source="these rooms")]
    config = EvaluationConfig(image_size=SIZE, clip_lengths=(4,), stride=2, max_sequences=1, max_points=800)
    results = run(rooms, methods, tmp_path, config)
    names = [method.name for method in methods]
    assert names == ["LoG-VGGT", "constant depth", "mean depth map", "static camera", "untrained network"]
    assert [entry["method"] for entry in results["summary"]] == names
    trained, untrained = results["summary"][0], results["summary"][-1]
    assert trained["scale/abs_rel"] != untrained["scale/abs_rel"]
    print_report(results, Console(file=(page := io.StringIO())))
    write_report(results, tmp_path / "report.md")
    markdown = (tmp_path / "report.md").read_text()
    for text in (page.getvalue(), markdown):
        assert all(name in text for name in names)
        assert "these rooms" in text
        assert "†" in text
        assert "To get these numbers again: command" in text
    shown = f"{trained['scale/abs_rel']:.4f}"
    assert shown in page.getvalue()
    assert shown in markdown
    # The pictures of the first clip are drawn for the network.
    drawn = sorted(path.name for path in (tmp_path / "figures").iterdir())
    stem = f"{rooms.sequences[0]}_from_0_4_frames"
    assert drawn == [f"{stem}_depth.png", f"{stem}_trajectory.png"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"image_size": (56, 71)}, "image_size must be"),
        ({"clip_lengths": ()}, "clip_lengths must be"),
        ({"clip_lengths": (1,)}, "clip_lengths must be"),
        ({"stride": 0}, "stride must be at least 1"),
        ({"max_points": 0}, "max_points must be at least 1"),
        ({"icp_threshold": -1.0}, "icp_threshold must be positive"),
        ({"stride": 1.5}, "stride must be a whole number"),
        ({"length": 4}, "unknown field evaluation.length"),
    ],
)
def test_wrong_settings_are_named(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EvaluationConfig.from_dict({"image_size": SIZE, "clip_lengths": (4,), **values})


def test_a_configuration_states_all_fields_and_no_other() -> None:
    fields = {"title": "t", "dataset": "rooms", "split": "test", "baselines": False}
    evaluation = {"image_size": SIZE, "clip_lengths": [4]}
    run = EvaluationRun.from_dict({**fields, "evaluation": evaluation})
    assert run.evaluation == EvaluationConfig(image_size=SIZE, clip_lengths=(4,))
    with pytest.raises(ValueError, match="unknown field data_set; known are title, dataset"):
        EvaluationRun.from_dict({**fields, "evaluation": evaluation, "data_set": "rooms"})
    with pytest.raises(ValueError, match="field evaluation is missing"):
        EvaluationRun.from_dict(fields)
    with pytest.raises(ValueError, match=r"field evaluation\.clip_lengths is missing"):
        EvaluationRun.from_dict({**fields, "evaluation": {"image_size": SIZE}})


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half\ud800")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]
