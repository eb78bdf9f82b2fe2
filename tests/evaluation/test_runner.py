"""Whole evaluations of small rooms with methods whose results are known beforehand."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console

from logvggt_jax.config import ModelConfig
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.evaluation.clips import ClipData
from logvggt_jax.evaluation.methods.baselines import all_baselines, depth_statistics, static_camera
from logvggt_jax.evaluation.methods.method import ClipPrediction, Method, network
from logvggt_jax.evaluation.protocols import PointsMeasure
from logvggt_jax.evaluation.protocols.clips import clip_protocols
from logvggt_jax.evaluation.report.report import print_report, tables, write_report
from logvggt_jax.evaluation.runner import Benchmark, Clip, evaluate, plan_clips
from logvggt_jax.evaluation.scores import ClipScore, benchmark_score, clip_score, points_at, prepare_truth
from logvggt_jax.evaluation.settings import BenchmarkRun, EvaluationConfig, EvaluationRun, read_run
from logvggt_jax.files import write_text
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


def benchmarks_of(dataset: Any, config: EvaluationConfig = CONFIG) -> list[Benchmark]:
    return [Benchmark(protocol, dataset, "test") for protocol in clip_protocols("rooms", "test", config)]


def run(
    dataset: Any, methods: Sequence[Method], output: Path, config: EvaluationConfig = CONFIG, identity: str = ""
) -> dict:
    return evaluate(
        benchmarks_of(dataset, config),
        methods,
        output,
        title="rooms",
        command="command",
        configuration=dataclasses.asdict(config),
        identity=identity,
        max_sequences=config.max_sequences,
        figures=config.figures,
        console=Console(file=io.StringIO()),
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
    assert set(lines[0]) == {"environment"}
    assert len(lines) == 1 + 2 * 2 * 2
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
    assert "ate" not in spoiled
    assert whole["clips_depth"] == whole["clips_pose"] == 2
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
        self.rooms, self.sequences = rooms, rooms.sequences

    def num_frames(self, sequence: str) -> int:
        return self.rooms.num_frames(sequence)

    def frame_names(self, sequence: str) -> list[str]:
        return list(self.rooms.frame_names(sequence))

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        if sequence == self.sequences[1]:
            raise OSError("frame-000003.color.png is truncated")
        return self.rooms.read(sequence, indices)


def test_clips_that_cannot_be_read_are_listed_and_counted(rooms: Rooms, tmp_path: Path) -> None:
    config = EvaluationConfig(image_size=SIZE, clip_lengths=(4, 40), figures=0)
    results = run(Broken(rooms), [static_camera()], tmp_path, config)
    reasons = [(entry["frames"], entry["reason"]) for entry in results["skipped"]]
    assert (4, "frame-000003.color.png is truncated") in reasons
    assert sum(frames == 40 and "has 16 frames" in why for frames, why in reasons) == 2
    (entry,) = results["summary"]
    assert (entry["clips_pose"], entry["clips"]) == (1, 2)
    assert tables(results)[0].rows[0][-1] == "1/2"


def test_an_evaluation_of_nothing_is_an_error(rooms: Rooms, tmp_path: Path) -> None:
    config = EvaluationConfig(image_size=SIZE, clip_lengths=(50,))
    with pytest.raises(ValueError, match="no clip could be evaluated"):
        run(rooms, [static_camera()], tmp_path / "out", config)
    assert list(tmp_path.iterdir()) == []


def test_methods_of_one_name_are_refused(rooms: Rooms, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unique names"):
        run(rooms, [static_camera(), static_camera()], tmp_path)


def failing(message: str, *, at_call: int, error: type[Exception] = RuntimeError) -> tuple[Method, list[int]]:
    calls: list[int] = []

    def predict(images: np.ndarray) -> ClipPrediction:
        calls.append(len(images))
        if len(calls) == at_call:
            raise error(message)
        return static_camera().predict(images)

    return dataclasses.replace(static_camera(), predict=predict), calls


def test_a_killed_evaluation_goes_on_where_it_stopped(rooms: Rooms, tmp_path: Path) -> None:
    whole = run(rooms, [static_camera()], tmp_path / "whole")
    method, calls = failing("killed", at_call=3)
    with pytest.raises(RuntimeError, match="killed"):
        run(rooms, [method], tmp_path / "killed")
    lines = tmp_path / "killed" / "clips.jsonl"
    assert len(lines.read_text().splitlines()) == 1 + 2
    # What a kill in the middle of a write leaves behind.
    with lines.open("a") as file:
        file.write('{"key": "half')
    resumed = run(rooms, [method], tmp_path / "killed")
    assert len(calls) == 3 + 2, "two of four clips were left, and the third call had failed"
    assert resumed["summary"] == whole["summary"]
    again = run(rooms, [method], tmp_path / "killed")
    assert len(calls) == 5
    assert again["summary"] == whole["summary"]
    for name in ("whole", "killed"):
        records = [json.loads(line) for line in (tmp_path / name / "clips.jsonl").read_text().splitlines()]
        assert sum("key" in record for record in records) == 4


def test_results_of_other_settings_or_parameters_are_not_taken_over(rooms: Rooms, tmp_path: Path) -> None:
    method, calls = failing("", at_call=-1)
    run(rooms, [method], tmp_path, identity="a")
    run(rooms, [method], tmp_path, identity="b")
    assert len(calls) == 8
    run(rooms, [method], tmp_path, dataclasses.replace(CONFIG, seed=1), identity="b")
    assert len(calls) == 12
    records = [json.loads(line) for line in (tmp_path / "clips.jsonl").read_text().splitlines()]
    assert len(records) == 1 + 4
    assert (tmp_path / "results.json").exists()


@pytest.mark.parametrize(("error", "message"), [(ValueError, "needs fewer frames"), (MemoryError, "out of memory")])
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
    assert not again["failures"]
    assert len(calls) == 5


def test_a_method_that_fails_everywhere_is_an_error(rooms: Rooms, tmp_path: Path) -> None:
    def refuse(images: np.ndarray) -> ClipPrediction:
        raise ValueError("images must be multiples of 16")

    with pytest.raises(ValueError, match="no method could predict any clip; the first says: images must be"):
        run(rooms, [dataclasses.replace(static_camera(), predict=refuse)], tmp_path)


def test_only_an_exhausted_device_counts_as_out_of_memory(rooms: Rooms, tmp_path: Path) -> None:
    method, _ = failing("RESOURCE_EXHAUSTED: Out of memory allocating", at_call=1, error=jax.errors.JaxRuntimeError)
    assert "out of memory on the device" in run(rooms, [method], tmp_path / "a")["failures"][0]["reason"]
    method, _ = failing("INTERNAL: broken", at_call=1, error=jax.errors.JaxRuntimeError)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        run(rooms, [method], tmp_path / "b")


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
    benchmarks = benchmarks_of(rooms, config)
    clips, skipped = plan_clips(benchmarks, 1)
    assert not skipped
    assert [clip.indices for clip in clips] == [(0, 2, 4, 6), (4, 6, 8, 10), (9, 11, 13, 15)]
    assert clips[0] == Clip(benchmarks[0], rooms.sequences[0], (0, 2, 4, 6))


def test_points_of_chosen_pixels_equal_those_of_all(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 5, 9])
    points = unproject(*(np.asarray(x, np.float64) for x in (frames.depth, frames.intrinsics, frames.extrinsics)))
    indices = np.array([0, 17, 28 * 42 - 1, 2 * 28 * 42, 3 * 28 * 42 - 1])
    chosen = points_at(frames.depth, frames.intrinsics, frames.extrinsics, indices)
    np.testing.assert_allclose(chosen, points.reshape(-1, 3)[indices])


def clip_of(frames: Frames) -> ClipData:
    return ClipData(frames.images, frames.depth, frames.intrinsics, frames.extrinsics)


def test_invalid_pixels_give_no_true_points(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 3, 6])
    depth = frames.depth.copy()
    depth[1] = 0.0
    depth[:, :10] = 0.0
    truth = prepare_truth(clip_of(frames._replace(depth=depth)), PointsMeasure(max_points=None))
    assert truth.indices is not None
    np.testing.assert_array_equal(truth.indices, np.flatnonzero(depth > 0))
    nothing = prepare_truth(clip_of(frames._replace(depth=np.zeros_like(depth))), PointsMeasure())
    protocol = clip_protocols("rooms", "test", CONFIG)[0]
    score = clip_score(oracle(frames), oracle(frames).predict(frames.images), nothing, protocol)
    assert set(score.failures) == {"depth", "points"}


@pytest.mark.parametrize("max_points", [None, 100])
def test_only_the_middle_of_each_frame_is_compared(rooms: Rooms, max_points: int | None) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 3])
    truth = prepare_truth(clip_of(frames), PointsMeasure(crop=12, max_points=max_points))
    assert truth.indices is not None
    rows, columns = np.divmod(truth.indices % (28 * 42), 42)
    assert (rows.min() >= 14 - 6, rows.max() < 14 + 6, columns.min() >= 21 - 6, columns.max() < 21 + 6) == (True,) * 4
    assert len(np.unique(truth.indices)) == (max_points or 2 * 12 * 12)
    assert (np.diff(truth.indices) > 0).all()


def test_one_frame_alone_gives_depth_and_points_and_names_the_rest(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [5])
    protocol = clip_protocols("rooms", "test", CONFIG)[0]
    truth = prepare_truth(clip_of(frames), protocol.points)
    score = clip_score(oracle(frames), oracle(frames).predict(frames.images), truth, protocol)
    assert set(score.failures) == {"pose", "trajectory"}
    assert "at least 2 frames" in score.failures["pose"]
    assert score.metrics["acc_mean"] < 1e-5


def test_a_straight_true_trajectory_is_named(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4, 6])
    frames.extrinsics[:, :3, 3] = 0.0
    frames.extrinsics[:, :3, :3] = np.eye(3)
    frames.extrinsics[:, 0, 3] = np.arange(4)
    protocol = clip_protocols("rooms", "test", CONFIG)[0]
    truth = prepare_truth(clip_of(frames), None)
    score = clip_score(oracle(frames), oracle(frames).predict(frames.images), truth, protocol)
    assert "neither stand still nor be straight" in score.failures["trajectory"]
    assert score.metrics["rra@30"] == 1.0


def test_a_prediction_of_zeros_is_not_measurable(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4])
    protocol = clip_protocols("rooms", "test", CONFIG)[0]
    flat = oracle(frames).predict(frames.images)._replace(depth=np.zeros_like(frames.depth))
    score = clip_score(oracle(frames), flat, prepare_truth(clip_of(frames), protocol.points), protocol)
    assert "cannot be aligned" in score.failures["depth"]
    assert not any(key.startswith("scale/") for key in score.metrics)


def test_errors_against_a_second_set_of_poses_stand_beside_the_first(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4, 6])
    protocol = clip_protocols("rooms", "test", CONFIG)[0]
    shaken = frames.extrinsics.copy()
    shaken[2, :3, 3] += 0.5
    clip = clip_of(frames)._replace(sfm_extrinsics=shaken)
    score = clip_score(oracle(frames), oracle(frames).predict(frames.images), prepare_truth(clip, None), protocol)
    assert score.metrics["ate"] < 1e-5 < 0.01 < score.metrics["sfm/ate"]
    mean = benchmark_score(protocol, oracle(frames), [("a", score)], 1)
    assert mean["sfm/ate"] == score.metrics["sfm/ate"]
    assert mean["clips_sfm/trajectory"] == 1


def test_score_weighs_depth_by_pixels_and_poses_plainly() -> None:
    def clip(value: float, pixels: float) -> ClipScore:
        names = ("abs_rel", "sq_rel", "rmse", "log_rmse", "delta_1.25", "delta_1.25^2", "delta_1.25^3")
        metrics = {f"{alignment}/{name}": value for alignment in ("scale", "median") for name in names}
        poses = dict.fromkeys(("rra@5", "rra@30", "rta@30", "auc@30"), value)
        rotation = {"rotation_error": value, "identity_rotation_error": 2.0, "pairs": pixels}
        return ClipScore({**metrics, "valid_pixels": pixels, **poses, **rotation}, {})

    protocol = clip_protocols("rooms", "test", CONFIG)[0]
    method = Method("any", "", lambda images: static_camera().predict(images))
    scores = [("a/1", clip(0.1, 300)), ("a/2", clip(0.5, 100)), ("b/1", clip(0.8, 50))]
    score = benchmark_score(protocol, method, scores[:2], 3)
    assert score["scale/abs_rel"] == pytest.approx(0.2)
    assert score["auc@30"] == pytest.approx(0.3)
    assert score["rotation_ratio"] == pytest.approx(0.15)
    assert (score["clips_points"], score["clips_depth"], score["clips"]) == (0, 2, 3)
    # Pairs pooled in category a (0.2), then the mean with b.
    pooled = benchmark_score(dataclasses.replace(protocol, pooled=True), method, scores, 3)
    assert pooled["auc@30"] == pytest.approx((0.2 + 0.8) / 2)
    assert pooled["categories"] == 2


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
    assert results["environments"][0]["versions"]["jax"] == jax.__version__
    names = [method.name for method in methods]
    assert names == ["LoG-VGGT", "constant depth", "mean depth map", "static camera", "untrained network"]
    assert [entry["method"] for entry in results["summary"]] == names
    trained, untrained = results["summary"][0], results["summary"][-1]
    assert trained["scale/abs_rel"] != untrained["scale/abs_rel"]
    print_report(results, Console(file=(terminal := io.StringIO())))
    write_report(results, tmp_path)
    markdown = (tmp_path / "report.md").read_text()
    for text in (terminal.getvalue(), markdown):
        assert all(name in text for name in names)
        assert "these rooms" in text
        assert "†" in text
        assert "To get these numbers again: command" in text
    shown = f"{trained['scale/abs_rel']:.4f}"
    assert shown in terminal.getvalue()
    assert shown in markdown
    # The pictures of the first clip are drawn for the network.
    drawn = sorted(path.name for path in (tmp_path / "figures").iterdir())
    stem = f"rooms-clips-4_{rooms.sequences[0]}_from_0_4_frames"
    assert drawn == [f"{stem}_depth.png", f"{stem}_points.png", f"{stem}_trajectory.png"]
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert f"<b>{shown}</b>" in page or f"<td>{shown}</td>" in page
    assert not re.search(r'(src|href)="(?!data:)', page), "the page refers to no other file"
    tables_written = sorted(path.name for path in (tmp_path / "tables").iterdir())
    assert tables_written[0] == "01-depth-clips-of-4-frames.csv"
    rows = list(csv.reader((tmp_path / "tables" / tables_written[0]).read_text().splitlines()))
    assert rows[0][:2] == ["method", "Abs Rel (scale) ↓"]
    assert rows[1][:2] == ["LoG-VGGT", shown]


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


_CLIP_FIELDS = {"title": "t", "dataset": "rooms", "split": "test", "baselines": False}


def test_a_configuration_states_all_fields_and_no_other() -> None:
    fields = _CLIP_FIELDS
    evaluation = {"image_size": SIZE, "clip_lengths": [4]}
    run = EvaluationRun.from_dict({**fields, "evaluation": evaluation})
    assert run.evaluation == EvaluationConfig(image_size=SIZE, clip_lengths=(4,))
    with pytest.raises(ValueError, match="unknown field data_set; known are title, dataset"):
        EvaluationRun.from_dict({**fields, "evaluation": evaluation, "data_set": "rooms"})
    with pytest.raises(ValueError, match="field evaluation is missing"):
        EvaluationRun.from_dict(fields)
    with pytest.raises(ValueError, match=r"field evaluation\.clip_lengths is missing"):
        EvaluationRun.from_dict({**fields, "evaluation": {"image_size": SIZE}})


def test_a_benchmark_run_is_known_by_its_benchmarks() -> None:
    values = {"title": "t", "benchmarks": ["*"], "baselines": True, "protocol": {"longer_edge": 70}}
    run = read_run(values)
    assert isinstance(run, BenchmarkRun)
    assert run.protocol.longer_edge == 70
    for field, value, message in (
        ("protocol", {"longer_edge": 71}, "longer_edge must be a multiple of 14"),
        ("protocol", {"long_edge": 70}, "unknown field protocol.long_edge"),
        ("protocol", {"max_points": 0}, "max_points must be"),
        ("benchmarks", (), "benchmarks must name at least one"),
        ("max_sequences", 0, "max_sequences must be at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            read_run({**values, field: value})
    assert isinstance(
        read_run({**_CLIP_FIELDS, "evaluation": {"image_size": SIZE, "clip_lengths": [4]}}), EvaluationRun
    )


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half\ud800")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]
