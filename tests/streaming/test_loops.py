"""Loops on walks through rooms whose truth is known, predicted by a stand-in that drifts within every chunk."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.config import from_mapping
from logvggt_jax.data import open_dataset
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import decode_poses, invert, relative_to_first, similarity_exp
from logvggt_jax.metrics import trajectory_errors
from logvggt_jax.streaming import ChunkPlan, ChunkSession, FrameResult, LoopSettings, PredictionError
from logvggt_jax.streaming import chunks as module
from logvggt_jax.streaming.loops import LoopCloser, candidates
from logvggt_jax.streaming.offline import PlainPrediction
from logvggt_jax.streaming.results import Cameras

HEIGHT, WIDTH = 42, 56
LAP = 48
# Of every frame within a chunk: translation, rotation in radians, logarithm of the scale.
DRIFT = np.array([0.004, 0.0, 0.002, 0.002, 0.01, 0.001, 0.006])
LOOPS = LoopSettings(spacing=2, gap=20, frames=3)
PLAN = ChunkPlan(12, 4, LOOPS)


def walk(rooms: int = 1, **options: int) -> list[Frames]:
    """Frames of so many rooms."""
    data = open_dataset("rooms", None, split="test", num_rooms=rooms, height=HEIGHT, width=WIDTH, period=LAP, **options)
    return [data.read(sequence, range(data.num_frames(sequence))) for sequence in data.sequences]


@pytest.fixture(scope="module")
def laps() -> Frames:
    """Three times round a room."""
    return walk(laps=3, num_frames=3 * LAP)[0]


def beginning(frames: Frames, count: int) -> Frames:
    return Frames(*(getattr(frames, name)[:count] for name in ("images", "depth", "intrinsics", "extrinsics")), True)


class Standin:
    """Knows frames by their images. Neighbours drift apart from frame to frame; places that lie apart come as they are.

    Every prediction has a world and a unit of its own.
    """

    def __init__(self, truth: Frames, together: np.ndarray | None = None) -> None:
        self.truth, self.extrinsics = truth, truth.extrinsics.astype(np.float64)
        self.together = self.extrinsics if together is None else together
        self.numbers = {image.tobytes(): index for index, image in enumerate(truth.images)}
        self.joint: list[list[int]] = []
        self.generator = np.random.default_rng(0)

    def __call__(self, model: LogVGGT, variables: dict, images: np.ndarray) -> PlainPrediction:
        numbers = [self.numbers[image.tobytes()] for image in images]
        poses = relative_to_first(self.extrinsics[numbers])
        scale = np.ones(len(numbers))
        if (np.diff(numbers) == 1).all():
            poses, scale = drifted(poses)
        else:
            self.joint.append(numbers)
            poses = relative_to_first(self.together[numbers])
        unit = self.generator.uniform(0.5, 2.0)
        poses[:, :3, 3] *= unit
        depth = self.truth.depth[numbers] * (unit * scale)[:, None, None]
        confidence = np.full(depth.shape, 2.0, np.float32)
        cameras = poses[:, :3].astype(np.float32)
        return PlainPrediction(depth.astype(np.float32), confidence, cameras, self.truth.intrinsics[numbers])


def drifted(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera poses [n, 4, 4] with every step a little wrong, and the scale of the depth [n]."""
    placed = [np.eye(4)]
    for before, after in itertools.pairwise(poses):
        placed.append(placed[-1] @ before @ np.linalg.inv(after) @ similarity_exp(DRIFT))
    scale = np.exp(DRIFT[6] * np.arange(len(poses)))
    rigid = np.stack(placed)
    rigid[:, :3, :3] /= scale[:, None, None]
    return invert(rigid), scale


def run(
    predict: Standin,
    plan: ChunkPlan,
    config: ModelConfig,
    variables: dict,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[list[FrameResult], Cameras]:
    monkeypatch.setattr(module, "predict_plain", predict)
    session = ChunkSession(LogVGGT(config), variables, plan)
    results = [result for image in predict.truth.images for result in session.push(image)]
    assert len(session.cameras().is_final) == len(results)
    assert not session.cameras().is_final.any() or not plan.loops
    return results + session.close(), session.cameras()


def ate(cameras: Cameras, truth: Frames) -> float:
    poses = [invert(x.astype(np.float64)) for x in (cameras.extrinsics, truth.extrinsics)]
    return float(trajectory_errors(*poses)["ate"])


@pytest.mark.parametrize("count", [2, 3])
def test_laps_with_drift_close(
    count: int, laps: Frames, small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    laps = beginning(laps, count * LAP)
    _, apart = run(Standin(laps), ChunkPlan(12, 4), small_config, small_variables, monkeypatch)
    results, closed = run(Standin(laps), PLAN, small_config, small_variables, monkeypatch)
    assert ate(closed, laps) < ate(apart, laps) / 5
    assert closed.is_final.all() and not any(result.pose_is_final for result in results)
    assert closed.loops is not None and (np.diff(closed.loops) >= LOOPS.gap).all()
    # The world stays the first camera's.
    np.testing.assert_array_equal(closed.extrinsics[0], apart.extrinsics[0])
    # Depth goes with the cameras: the same factor to the truth all along, where it drifted before.
    assert closed.depth_scale is not None
    ratio = np.array([np.median(result.depth / depth) for result, depth in zip(results, laps.depth, strict=True)])
    assert np.ptp(np.log(ratio)) > 0.5
    assert np.ptp(np.log(ratio * closed.depth_scale)) < np.ptp(np.log(ratio)) / 3
    # Encodings, extrinsics and intrinsics say the same.
    extrinsics, intrinsics = decode_poses(closed.pose_encoding, (HEIGHT, WIDTH))
    np.testing.assert_allclose(extrinsics, closed.extrinsics, atol=1e-5)
    np.testing.assert_allclose(intrinsics, closed.intrinsics, rtol=1e-5)


@pytest.mark.parametrize("fooled", [False, True])
def test_rooms_that_look_alike_are_no_loop(
    fooled: bool, small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From one room into another whose walls have the same colours, seen together as they are or as one room."""
    one, other = walk(2, num_frames=LAP)
    moved = other.extrinsics.copy()
    moved[:, :3, 3] -= moved[:, :3, :3] @ np.array([12.0, 0.0, 0.0], np.float32)
    fields = [np.concatenate(parts) for parts in ((one.images, other.images), (one.depth, other.depth))]
    intrinsics = np.concatenate([one.intrinsics, other.intrinsics])
    both = Frames(*fields, intrinsics, np.concatenate([one.extrinsics, moved]), True)
    same = np.concatenate([one.extrinsics, other.extrinsics]).astype(np.float64) if fooled else None
    _, expected = run(Standin(both), ChunkPlan(12, 4), small_config, small_variables, monkeypatch)
    predict = Standin(both, same)
    # So far apart lie frames of both rooms alone.
    plan = ChunkPlan(12, 4, dataclasses.replace(LOOPS, gap=LAP))
    _, cameras = run(predict, plan, small_config, small_variables, monkeypatch)
    assert predict.joint, "no candidate: nothing was put to the check"
    assert cameras.loops is not None and len(cameras.loops) == 0 and cameras.depth_scale is None
    for name in ("pose_encoding", "extrinsics", "intrinsics", "is_final"):
        np.testing.assert_array_equal(getattr(cameras, name), getattr(expected, name), err_msg=name)


def test_without_a_loop_nothing_changes(
    laps: Frames, small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = beginning(laps, 30)
    expected, before = run(Standin(start), ChunkPlan(12, 4), small_config, small_variables, monkeypatch)
    results, cameras = run(Standin(start), PLAN, small_config, small_variables, monkeypatch)
    for result, other in zip(results, expected, strict=True):
        np.testing.assert_array_equal(result.depth, other.depth)
        np.testing.assert_array_equal(result.pose_encoding, other.pose_encoding)
    assert cameras.depth_scale is None and cameras.loops is not None and len(cameras.loops) == 0
    for name in ("pose_encoding", "extrinsics", "intrinsics", "is_final"):
        np.testing.assert_array_equal(getattr(cameras, name), getattr(before, name), err_msg=name)


def test_a_stream_goes_on_from_a_snapshot_to_the_same_loops(
    laps: Frames, small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, expected = run(Standin(laps), PLAN, small_config, small_variables, monkeypatch)
    predict = Standin(laps)
    monkeypatch.setattr(module, "predict_plain", predict)
    session = ChunkSession(LogVGGT(small_config), small_variables, PLAN)
    session.push(laps.images[:101])
    _, arrays = session.snapshot()
    session = ChunkSession(LogVGGT(small_config), small_variables, PLAN)
    session.restore({name: array.copy() for name, array in arrays.items()})
    session.push(laps.images[101:])
    session.close()
    for name, array in session.cameras()._asdict().items():
        np.testing.assert_array_equal(array, getattr(expected, name), err_msg=name)
    assert expected.loops is not None and len(expected.loops)


def test_a_loop_of_two_frames_is_refused(laps: Frames) -> None:
    closer = LoopCloser(lambda images: images, lambda images: None, LoopSettings())  # type: ignore
    for image in laps.images[:2]:
        closer.see(image)
    with pytest.raises(PredictionError, match="a loop needs at least three frames, this sequence has 2: give a longer"):
        closer.close(Cameras(*[np.zeros((2, 9))] * 4))
    with pytest.raises(InputError, match=r"LoopSettings\.gap must be an integer of at least 3, got 2"):
        LoopSettings(gap=2)


def test_places_are_bounded() -> None:
    closer = LoopCloser(lambda images: images, lambda images: None, LoopSettings(spacing=1, max_places=8))  # type: ignore
    for index in range(100):
        closer.see(np.full((14, 28, 3), index, np.uint8))
        assert len(closer._places) <= 8
    assert list(closer._places) == list(range(0, 100, 16))
    assert all((place.image == index).all() for index, place in closer._places.items())


def test_candidates_are_each_others_best_far_apart_and_spread() -> None:
    angles = np.linspace(0, 4 * np.pi, 80, endpoint=False)  # twice round
    descriptors = 10 + np.stack([np.cos(angles), np.sin(angles), 0.001 * angles], axis=1)
    indices = 5 * np.arange(80)
    found = candidates(descriptors, indices, LoopSettings(), gap=60)
    pairs = indices[np.array(found)]
    assert len(pairs) > 5 and (np.abs(np.diff(pairs) - 200) <= 5).all()
    apart = np.abs(pairs[:, None] - pairs).max(-1)[~np.eye(len(pairs), dtype=bool)]
    assert apart.min() >= 15
    assert candidates(descriptors, indices, LoopSettings(), gap=400) == []
    assert len(candidates(descriptors, indices, LoopSettings(max_candidates=2), gap=60)) == 2
    assert candidates(np.eye(80), indices, LoopSettings(), gap=60) == []


def test_settings_come_from_a_configuration() -> None:
    plan = from_mapping(ChunkPlan, {"size": 12, "overlap": 6, "loops": {"gap": 20}}, "settings")
    assert plan == ChunkPlan(12, 6, LoopSettings(gap=20))
    assert from_mapping(ChunkPlan, {"loops": True}, "settings").loops is True
