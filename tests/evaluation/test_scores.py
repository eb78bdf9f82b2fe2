"""What is measured on one clip, and means over clips."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from known_answers import SETTINGS, SIZE, clip_of, oracle

from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.evaluation import scores, scratch
from logvggt_jax.evaluation.methods.baselines import static_camera
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.protocols import PointsMeasure
from logvggt_jax.evaluation.protocols.clips import clip_protocols
from logvggt_jax.evaluation.scores import (
    ClipScore,
    ClipTruth,
    benchmark_score,
    clip_score,
    prepare_truth,
    valid_pixels,
)
from logvggt_jax.evaluation.scratch import scratch_array
from logvggt_jax.metrics import depth_metrics
from logvggt_jax.metrics.depth import pixel_errors, resize_depth
from logvggt_jax.metrics.pose import relative_pose_errors
from logvggt_jax.types import Frames

PROTOCOL = clip_protocols("rooms", "test", SETTINGS, SIZE)[0]


def score_of(frames: Frames, truth: ClipTruth, **changes: np.ndarray) -> ClipScore:
    """The oracle's score on these frames, its prediction changed."""
    method = oracle(frames)
    return clip_score(method, method.predict(frames.images)._replace(**changes), truth, PROTOCOL)


def test_invalid_pixels_give_no_true_points(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 3, 6])
    depth = frames.depth.copy()
    depth[1] = 0.0
    depth[:, :10] = 0.0
    truth = prepare_truth(clip_of(frames._replace(depth=depth)), PointsMeasure(max_points=None))
    assert truth.indices is not None
    np.testing.assert_array_equal(truth.indices, np.flatnonzero(depth > 0))
    nothing = prepare_truth(clip_of(frames._replace(depth=np.zeros_like(depth))), PointsMeasure())
    score = score_of(frames, nothing)
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
    score = score_of(frames, prepare_truth(clip_of(frames), PROTOCOL.points))
    assert set(score.failures) == {"pose", "trajectory"}
    assert "at least 2 frames" in score.failures["pose"] and score.metrics["acc_mean"] < 1e-5


def test_a_straight_true_trajectory_is_named(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4, 6])
    frames.extrinsics[:, :3, 3] = 0.0
    frames.extrinsics[:, :3, :3] = np.eye(3)
    frames.extrinsics[:, 0, 3] = np.arange(4)
    score = score_of(frames, prepare_truth(clip_of(frames), None))
    assert "neither stand still nor be straight" in score.failures["trajectory"]
    assert score.metrics["rra@30"] == 1.0


def test_a_prediction_of_zeros_is_not_measurable(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4])
    truth = prepare_truth(clip_of(frames), PROTOCOL.points)
    score = score_of(frames, truth, depth=np.zeros_like(frames.depth))
    assert "cannot be aligned" in score.failures["depth"]
    assert not any(key.startswith("scale/") for key in score.metrics)


def test_errors_against_a_second_set_of_poses_stand_beside_the_first(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4, 6])
    shaken = frames.extrinsics.copy()
    shaken[2, :3, 3] += 0.5
    clip = clip_of(frames)._replace(sfm_extrinsics=shaken)
    score = score_of(frames, prepare_truth(clip, None))
    assert score.metrics["ate"] < 1e-5 < 0.01 < score.metrics["sfm/ate"]
    mean = benchmark_score(PROTOCOL, oracle(frames), [("a", score)], 1)
    assert mean["sfm/ate"] == score.metrics["sfm/ate"] and mean["clips_sfm/trajectory"] == 1


def test_a_motionless_camera_is_judged_once_a_clip(rooms: Rooms, monkeypatch: pytest.MonkeyPatch) -> None:
    still: list[int] = []

    def counted(predicted: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        still.append(int((predicted[:, :3, :3] == np.eye(3)).all()))
        return relative_pose_errors(predicted, true)

    monkeypatch.setattr(scores, "relative_pose_errors", counted)
    frames = rooms.read(rooms.sequences[0], [0, 2, 4, 6])
    truth = prepare_truth(clip_of(frames), None)
    found = [score_of(frames, truth).metrics["identity_rotation_error"] for _ in range(3)]
    assert sum(still) == 1 and len(still) == 4 and found[0] == found[2] > 0


def test_score_weighs_depth_by_pixels_and_poses_plainly() -> None:
    def clip(value: float, pixels: float) -> ClipScore:
        names = ("abs_rel", "sq_rel", "rmse", "log_rmse", "delta_1.25", "delta_1.25^2", "delta_1.25^3")
        metrics = {f"{alignment}/{name}": value for alignment in ("scale", "median") for name in names}
        poses = dict.fromkeys(("rra@5", "rra@30", "rta@30", "auc@30"), value)
        rotation = {"rotation_error": value, "identity_rotation_error": 2.0, "pairs": pixels}
        return ClipScore({**metrics, "valid_pixels": pixels, **poses, **rotation}, {})

    method = Method("any", "", lambda images: static_camera().predict(images))
    scores = [("a/1", clip(0.1, 300)), ("a/2", clip(0.5, 100)), ("b/1", clip(0.8, 50))]
    score = benchmark_score(PROTOCOL, method, scores[:2], 3)
    assert score["scale/abs_rel"] == pytest.approx(0.2) and score["auc@30"] == pytest.approx(0.3)
    assert score["rotation_ratio"] == pytest.approx(0.15)
    assert (score["clips_points"], score["clips_depth"], score["clips"]) == (0, 2, 3)
    # Pairs pooled in category a (0.2), then the mean with b.
    pooled = benchmark_score(dataclasses.replace(PROTOCOL, pooled=True), method, scores, 3)
    assert pooled["auc@30"] == pytest.approx((0.2 + 0.8) / 2) and pooled["categories"] == 2


def test_depth_is_resized_to_the_truth_frame_by_frame() -> None:
    rng = np.random.default_rng(0)
    target, prediction = rng.uniform(1, 2, (3, 20, 30)), rng.uniform(1, 2, (3, 10, 15))
    pixels = valid_pixels(prediction, target, 1.8)
    resized = resize_depth(prediction, (20, 30))
    assert pixel_errors(*pixels, alignment="scale", clip=1.9) == depth_metrics(
        resized, target, alignment="scale", max_depth=1.8, clip=1.9
    )


def test_pixels_of_a_long_clip_lie_on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """`tracemalloc` sees numpy's own arrays and no memory map."""
    monkeypatch.setattr(scratch, "_IN_MEMORY", 0)
    peaks = []
    for count in (4, 64):
        target, prediction = scratch_array((count, 60, 80), np.float32), scratch_array((count, 30, 40), np.float32)
        target[:], prediction[:] = 2.0, 1.0
        tracemalloc.start()
        pixels = valid_pixels(prediction, target, None)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert pixels[0].shape == pixels[1].shape == (count * 60 * 80,)
    assert peaks[1] < 1.1 * peaks[0]


def test_a_bug_in_a_metric_is_not_called_unmeasurable(rooms: Rooms) -> None:
    frames = rooms.read(rooms.sequences[0], [0, 2, 4])
    truth = prepare_truth(clip_of(frames), PROTOCOL.points)
    assert truth.points is not None
    with pytest.raises(ValueError, match=r"two .* arrays of corresponding points"):
        score_of(frames, dataclasses.replace(truth, points=truth.points[1:]))
    with pytest.raises(ValueError, match="2 predicted poses, 3 true ones"):
        score_of(frames, prepare_truth(clip_of(frames), None), extrinsics=frames.extrinsics[:2])
