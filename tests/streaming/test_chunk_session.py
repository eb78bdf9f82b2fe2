"""A stream in chunks: every frame once, in order, final, and cameras that agree with the results."""

from __future__ import annotations

import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.geometry import decode_poses
from logvggt_jax.streaming import ChunkPlan, ChunkSession
from logvggt_jax.streaming import chunks as module
from logvggt_jax.streaming.offline import PlainPrediction

SIZE = (28, 42)
IMAGES = np.random.default_rng(0).integers(0, 256, (9, *SIZE, 3), np.uint8)


@pytest.fixture
def session(small_config: ModelConfig, monkeypatch: pytest.MonkeyPatch) -> ChunkSession:
    """Chunks of four whose predictor turns the camera by a tenth of a radian a frame, in front of random depth."""
    depth = np.random.default_rng(1).uniform(1, 4, (256, *SIZE)).astype(np.float32)

    def predict(model: LogVGGT, variables: dict, images: np.ndarray) -> PlainPrediction:
        angle = 0.1 * np.arange(len(images))
        zero, one = np.zeros_like(angle), np.ones_like(angle)
        rows = [[np.cos(angle), zero, np.sin(angle), zero], [zero, one, zero, zero]]
        rows.append([-np.sin(angle), zero, np.cos(angle), zero])
        numbers = images[:, 0, 0, 0]
        intrinsics = np.tile(np.array([[40.0, 0, 21], [0, 40.0, 14], [0, 0, 1]], np.float32), (len(images), 1, 1))
        extrinsics = np.moveaxis(np.array(rows, np.float32), 2, 0)
        return PlainPrediction(depth[numbers], np.full((len(images), *SIZE), 2.0, np.float32), extrinsics, intrinsics)

    monkeypatch.setattr(module, "predict_plain", predict)
    return ChunkSession(LogVGGT(small_config), {"params": {}}, ChunkPlan(4, 2))


def test_results_come_in_order_and_final(session: ChunkSession) -> None:
    results, counts = [], []
    for image in IMAGES:
        results += session.push(image)
        counts.append(session.num_frames)
    assert counts == [0, 0, 0, 2, 2, 4, 4, 6, 6]
    results += session.close()
    assert [result.index for result in results] == list(range(9))
    assert all(result.pose_is_final for result in results)
    cameras = session.cameras()
    assert cameras.is_final.all()
    np.testing.assert_array_equal(cameras.pose_encoding, [result.pose_encoding for result in results])
    extrinsics, intrinsics = decode_poses(cameras.pose_encoding, SIZE)
    np.testing.assert_allclose(cameras.extrinsics, extrinsics, atol=1e-5)
    np.testing.assert_allclose(cameras.intrinsics, intrinsics, rtol=1e-5)
    # The chain adds the turns of its chunks up.
    turned = np.arctan2(cameras.extrinsics[:, 0, 2], cameras.extrinsics[:, 0, 0])
    np.testing.assert_allclose(turned, 0.1 * np.arange(9), atol=1e-4)


def test_misuse_is_named(session: ChunkSession) -> None:
    assert len(session.cameras().pose_encoding) == 0
    session.push(IMAGES[:2])
    with pytest.raises(ValueError, match="must be alike"):
        session.push(IMAGES[0, :14])
    with pytest.raises(ValueError, match="multiples of 14"):
        session.push(np.zeros((15, 28, 3), np.uint8))
    assert len(session.close()) == 2
    assert session.close() == []
    assert session.snapshot() == ([], {}), "nothing goes on from a closed stream"
    with pytest.raises(ValueError, match="closed"):
        session.push(IMAGES[0])


def test_signals_say_how_chunks_fit_and_survive_a_snapshot(session: ChunkSession, small_config: ModelConfig) -> None:
    session.push(IMAGES[:7])
    other = ChunkSession(LogVGGT(small_config), {"params": {}}, ChunkPlan(4, 2))
    other.restore(session.snapshot()[1])
    for each in (session, other):
        each.push(IMAGES[7:])
        each.close()
    signals = session.signals()
    # Chunks of four that share two begin to add frames at 4, 6 and 8; their predictions differ by nothing but a turn.
    assert np.flatnonzero(np.isfinite(signals.chunk_scale)).tolist() == [4, 6, 8]
    np.testing.assert_allclose(signals.chunk_scale[4::2], 1, atol=1e-4)
    assert signals.chunk_residual[4::2].max() < 1e-4 and np.isnan(signals.overlap_change).all()
    for found, expected in zip(other.signals(), signals, strict=True):
        np.testing.assert_array_equal(found, expected)
