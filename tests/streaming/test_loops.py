"""Loops on walks through rooms whose truth is known, predicted by a stand-in that drifts within every chunk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.data import open_dataset
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import compose, invert, relative_to_first, similarity_exp
from logvggt_jax.metrics import trajectory_errors
from logvggt_jax.streaming import ChunkPlan, ChunkSession, FrameResult, LoopSettings, PredictionError
from logvggt_jax.streaming import chunks as module
from logvggt_jax.streaming.loops import candidates
from logvggt_jax.streaming.offline import PlainPrediction
from logvggt_jax.streaming.results import Cameras

HEIGHT, WIDTH = 56, 84
LAP, LAPS = 60, 3
# Of every frame within a chunk: translation, rotation in radians, logarithm of the scale.
DRIFT = np.array([0.004, 0.0, 0.002, 0.002, 0.01, 0.001, 0.006])
LOOPS = LoopSettings(spacing=2, gap=30, frames=3)
PLAN = ChunkPlan(12, 6, LOOPS)


def walk(rooms: int = 1, **options: int) -> list[Frames]:
    """Frames of so many rooms."""
    data = open_dataset("rooms", None, split="test", num_rooms=rooms, height=HEIGHT, width=WIDTH, period=LAP, **options)
    return [data.read(sequence, range(data.num_frames(sequence))) for sequence in data.sequences]


@pytest.fixture(scope="module")
def laps() -> Frames:
    """Three times round a room."""
    return walk(laps=LAPS, num_frames=LAPS * LAP)[0]


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
    for before, after in zip(poses[:-1], poses[1:], strict=True):
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


def test_laps_with_drift_close(
    laps: Frames, small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, apart = run(Standin(laps), ChunkPlan(12, 6), small_config, small_variables, monkeypatch)
    results, closed = run(Standin(laps), PLAN, small_config, small_variables, monkeypatch)
    print(ate(apart, laps), ate(closed, laps), closed.loops)
    assert ate(closed, laps) < ate(apart, laps) / 5
    assert closed.is_final.all() and not any(result.pose_is_final for result in results)
    assert closed.loops is not None and (np.diff(closed.loops) >= LOOPS.gap).all()
    # The world stays the first camera's.
    np.testing.assert_array_equal(closed.extrinsics[0], apart.extrinsics[0])
    # Depth goes with the cameras: the same factor to the truth all along, where it drifted before.
    assert closed.depth_scale is not None
    ratio = np.array([np.median(result.depth / depth) for result, depth in zip(results, laps.depth, strict=True)])
    assert np.ptp(np.log(ratio)) > 0.8
    assert np.ptp(np.log(ratio * closed.depth_scale)) < 0.2
