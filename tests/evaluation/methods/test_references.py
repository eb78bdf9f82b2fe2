"""Reference rows: plain VGGT whole and in chunks, and what they refuse."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods import references as module
from logvggt_jax.evaluation.methods.method import Checkpoint, PredictionError
from logvggt_jax.evaluation.methods.references import ReferenceConfig, chunked_vggt, offline_vggt
from logvggt_jax.evaluation.methods.rows import model_rows
from logvggt_jax.streaming.offline import ChunkPrediction, predict_plain

IMAGES = np.random.default_rng(0).integers(0, 256, (6, 28, 42, 3), np.uint8)


def test_both_are_plain_vggt_where_a_chunk_holds_the_clip(small_config: ModelConfig, small_variables: dict) -> None:
    model = LogVGGT(small_config)
    expected = predict_plain(model, small_variables, IMAGES)
    limits = ReferenceConfig(max_frames=6, chunk_size=6, chunk_overlap=3)
    methods = model_rows(Checkpoint(model, small_variables, "digest"), ("offline", "chunks"), limits)
    assert [method.name for method in methods] == ["VGGT offline", "VGGT on chunks"]
    for method in methods:
        prediction = method.predict(IMAGES)
        for name in ("depth", "extrinsics", "intrinsics"):
            np.testing.assert_array_equal(getattr(prediction, name), getattr(expected, name))


def test_a_clip_beyond_the_limit_is_refused_before_it_runs(small_config: ModelConfig) -> None:
    method = offline_vggt(Checkpoint(LogVGGT(small_config), {}, ""), ReferenceConfig(max_frames=5))
    with pytest.raises(PredictionError, match=r"6 frames exceeds references\.max_frames=5"):
        method.predict(IMAGES)


def test_memory_that_runs_out_is_named(small_config: ModelConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(reason: str) -> None:
        def predict(*_: object) -> ChunkPrediction:
            raise jax.errors.JaxRuntimeError(reason)

        monkeypatch.setattr(module, "predict_plain", predict)

    method = offline_vggt(Checkpoint(LogVGGT(small_config), {}, ""), ReferenceConfig())
    fail("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 123 bytes")
    with pytest.raises(PredictionError, match=r"6 frames of 28 x 42 pixels does not fit .* below 6"):
        method.predict(IMAGES)
    fail("INTERNAL: something else")
    with pytest.raises(jax.errors.JaxRuntimeError, match="something else"):
        method.predict(IMAGES)


def test_chunks_that_do_not_fit_are_a_failed_prediction(
    small_config: ModelConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def predict(model: LogVGGT, variables: dict, images: np.ndarray) -> ChunkPrediction:
        shape = images.shape[:3]
        poses = np.tile(np.eye(4, dtype=np.float32)[:3], (len(images), 1, 1))
        return ChunkPrediction(np.full(shape, np.nan), np.ones(shape), poses, np.tile(np.eye(3), (len(images), 1, 1)))

    monkeypatch.setattr(module, "predict_plain", predict)
    with pytest.raises(PredictionError, match="cannot be aligned"):
        chunked_vggt(Checkpoint(LogVGGT(small_config), {}, ""), ReferenceConfig(None, 4, 2)).predict(IMAGES)


def test_an_unknown_method_is_named(small_config: ModelConfig) -> None:
    with pytest.raises(InputError, match="unknown 'window'; known are windows, offline, chunks"):
        model_rows(Checkpoint(LogVGGT(small_config), {}, ""), ("window",), ReferenceConfig())
