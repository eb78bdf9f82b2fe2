"""Plain VGGT made of the model's parts: no window, no memory, the same numbers in pieces."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, Predictions, WindowConfig
from logvggt_jax.model import windows as module
from logvggt_jax.streaming.chunks import ChunkChain, ChunkPlan
from logvggt_jax.streaming.offline import OfflineSession, OfflineSettings, PlainPrediction, plain_vggt, predict_plain

# As many as in other tests, with which the program of all of them is shared.
FRAMES = 4
IMAGES = np.random.default_rng(0).integers(0, 256, (FRAMES, 28, 42, 3), np.uint8)


@pytest.fixture(scope="module")
def whole(small_config: ModelConfig, small_variables: dict) -> PlainPrediction:
    return predict_plain(LogVGGT(small_config), small_variables, IMAGES)


@pytest.fixture(scope="module")
def in_one_window(small_config: ModelConfig, small_variables: dict) -> Predictions:
    """All frames, and the first one alone, in a window of another stride: sequences of one batch, of one program."""
    model = LogVGGT(dataclasses.replace(small_config, windows=WindowConfig(FRAMES, FRAMES - 1)))
    lengths = np.arange(FRAMES) < np.array([[FRAMES], [1]])
    return jax.device_get(jax.jit(model.apply)(small_variables, np.stack([IMAGES, IMAGES]), lengths))


def test_one_window_over_all_frames_whatever_its_stride(whole: PlainPrediction, in_one_window: Predictions) -> None:
    np.testing.assert_allclose(whole.depth, in_one_window.depth[0], rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(whole.extrinsics, in_one_window.extrinsics[0], rtol=2e-4, atol=2e-4)


def test_every_frame_sees_every_other(small_config: ModelConfig, small_variables: dict, whole: PlainPrediction) -> None:
    changed = IMAGES.copy()
    changed[-1] = 255 - changed[-1]
    other = predict_plain(LogVGGT(small_config), small_variables, changed)
    assert np.abs(other.depth[0] - whole.depth[0]).max() > 1e-4


def test_limited_trunk_and_periods_are_the_streams_not_vggts(small_config: ModelConfig) -> None:
    settings = dataclasses.replace(small_config.refinement, period=2, context=4)
    model = LogVGGT(dataclasses.replace(small_config, refinement=settings))
    assert plain_vggt(model, 7) == plain_vggt(LogVGGT(small_config), 7)


def test_pictures_are_all_that_is_kept_until_the_end(small_config: ModelConfig, small_variables: dict) -> None:
    session = OfflineSession(LogVGGT(small_config), small_variables, OfflineSettings())
    session.push(IMAGES)
    assert session.state_bytes == IMAGES.nbytes


def test_one_frame_alone(small_config: ModelConfig, small_variables: dict, in_one_window: Predictions) -> None:
    """A window of four frames holds it, so that the model is plain VGGT itself."""
    plain = predict_plain(LogVGGT(small_config), small_variables, IMAGES[:1])
    np.testing.assert_allclose(plain.depth, in_one_window.depth[1, :1], rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(plain.extrinsics, in_one_window.extrinsics[1, :1], rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("size", [FRAMES, FRAMES + 3])
def test_a_chunk_as_long_as_the_sequence_is_plain_vggt(
    small_config: ModelConfig, small_variables: dict, whole: PlainPrediction, size: int
) -> None:
    chain = ChunkChain(lambda chunk: predict_plain(LogVGGT(small_config), small_variables, chunk), ChunkPlan(size, 2))
    parts = [part for image in IMAGES if (part := chain.push(image)) is not None]
    last = chain.close()
    assert last is not None
    fields = zip(*(part[:4] for part in (*parts, last)), strict=True)
    for actual, expected in zip(fields, whole, strict=False):
        np.testing.assert_array_equal(np.concatenate(actual), expected)


def test_dense_heads_in_groups_give_the_same(
    small_config: ModelConfig, small_variables: dict, whole: PlainPrediction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_DENSE_PIXELS", 2 * 28 * 42)
    predictions = jax.jit(plain_vggt(LogVGGT(small_config), FRAMES).apply)(small_variables, IMAGES[None])
    np.testing.assert_allclose(predictions.depth[0], whole.depth, rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(predictions.depth_confidence[0], whole.depth_confidence, rtol=2e-4, atol=2e-4)
