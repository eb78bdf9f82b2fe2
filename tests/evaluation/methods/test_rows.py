"""Rows of the model: the methods that users run, by their names, and what they refuse."""

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.method import Checkpoint
from logvggt_jax.evaluation.methods.rows import ReferenceConfig, model_rows
from logvggt_jax.streaming import METHODS, PredictionError
from logvggt_jax.streaming.offline import predict_plain

IMAGES = np.random.default_rng(0).integers(0, 256, (6, 28, 42, 3), np.uint8)
LIMITS = ReferenceConfig(max_frames=6, chunk_size=6, chunk_overlap=3)


def test_windows_are_the_model_and_the_references_plain_vggt(small_config: ModelConfig, small_variables: dict) -> None:
    """Where a chunk holds the whole clip."""
    model = LogVGGT(small_config)
    rows = model_rows(Checkpoint(model, small_variables, "digest"), ("windows", "offline", "chunks"), LIMITS)
    assert [row.name for row in rows] == ["LoG-VGGT", "VGGT offline", "VGGT on chunks"]
    whole = jax.tree.map(lambda x: x[0], jax.jit(model.apply)(small_variables, IMAGES[None]))
    plain = predict_plain(model, small_variables, IMAGES)
    for row, expected in zip(rows, (whole, plain, plain), strict=True):
        prediction = row.predict(IMAGES)
        for name in ("depth", "extrinsics", "intrinsics"):
            np.testing.assert_allclose(getattr(prediction, name), getattr(expected, name), rtol=1e-4, atol=2e-5)


def test_rows_differ_by_method_parameters_and_limits(small_config: ModelConfig) -> None:
    def identities(digest: str, limits: ReferenceConfig) -> list[str]:
        rows = model_rows(Checkpoint(LogVGGT(small_config), {}, digest), tuple(METHODS), limits)
        return [str(row.identity) for row in rows]

    first = identities("a", LIMITS)
    assert len(set(first)) == len(METHODS) and not set(first) & set(identities("b", LIMITS))
    same = [a == b for a, b in zip(first, identities("a", ReferenceConfig(6, 6, 2)), strict=True)]
    assert same == [name != "chunks" for name in METHODS]


def test_a_clip_beyond_the_limit_is_refused(small_config: ModelConfig) -> None:
    checkpoint = Checkpoint(LogVGGT(small_config), {"params": {}}, "")
    (row,) = model_rows(checkpoint, ("offline",), ReferenceConfig(max_frames=5))
    with pytest.raises(PredictionError, match="6 frames exceeds max_frames=5"):
        row.predict(IMAGES)


def test_an_unknown_method_is_named(small_config: ModelConfig) -> None:
    with pytest.raises(InputError, match=r"config\.methods: unknown 'window'; known are windows, "):
        model_rows(Checkpoint(LogVGGT(small_config), {}, ""), ("window",), LIMITS)
