"""Clips streamed through the model: the numbers of `apply`, whatever the length and the refinement mode."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from logvggt_jax.config import ModelConfig
from logvggt_jax.evaluation import scratch, streaming
from logvggt_jax.evaluation.scratch import scratch_array
from logvggt_jax.evaluation.streaming import stream_clip
from logvggt_jax.model.logvggt import LogVGGT


def clip(count: int) -> np.ndarray:
    return np.random.default_rng(count).integers(0, 255, (count, 28, 42, 3), np.uint8)


@pytest.mark.parametrize(("count", "refinement"), [(1, {}), (5, {}), (7, {"period": 2, "context": 4})])
def test_a_streamed_clip_equals_the_whole(
    count: int, refinement: dict, small_config: ModelConfig, small_variables: dict
) -> None:
    settings = dataclasses.replace(small_config.refinement, **refinement)
    model = LogVGGT(dataclasses.replace(small_config, refinement=settings))
    images = clip(count)
    expected = jax.jit(model.apply)(small_variables, images[None])
    streamed = stream_clip(model, small_variables, images)
    np.testing.assert_allclose(streamed.depth, expected.depth[0], rtol=2e-5)
    np.testing.assert_allclose(streamed.extrinsics, expected.extrinsics[0], atol=2e-5)
    np.testing.assert_allclose(streamed.intrinsics, expected.intrinsics[0], rtol=1e-4)


def test_clips_of_other_lengths_need_no_other_program(small_config: ModelConfig, small_variables: dict) -> None:
    model = LogVGGT(small_config)
    stream_clip(model, small_variables, clip(6))
    programs = [function._cache_size() for function in (streaming._start, streaming._step, streaming._cameras)]
    stream_clip(model, small_variables, clip(9))
    assert programs == [f._cache_size() for f in (streaming._start, streaming._step, streaming._cameras)]


def test_large_arrays_lie_in_a_file_without_a_name(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr(scratch, "_IN_MEMORY", 1000)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert not isinstance(scratch_array((10, 10), np.float32), np.memmap)
    large = scratch_array((300, 2), np.float32)
    assert isinstance(large, np.memmap)
    assert not large.any()
    assert list(tmp_path.iterdir()) == [], "nothing is left behind, however the process ends"
    large[7] = 3.0
    assert large.sum() == 6.0


def test_a_full_disk_is_named_before_it_is_written(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(OSError, match=rf"{tmp_path}: a clip needs .* set TMPDIR"):
        scratch_array((2**50,), np.uint8)
