"""Rows of the model: the methods that users run, by their names, and what they refuse."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.evaluation.methods.method import Checkpoint, model_row
from logvggt_jax.streaming import METHODS, ChunkPlan, Method, OfflineSettings, PredictionError, WindowSettings
from logvggt_jax.streaming.offline import predict_plain

IMAGES = np.random.default_rng(0).integers(0, 256, (6, 28, 42, 3), np.uint8)
SETTINGS = {"windows": WindowSettings(), "offline": OfflineSettings(6), "chunks": ChunkPlan(6, 3)}
# Of them plain VGGT sees as many as in other tests, whose program is there already.
FEW = 4


def test_windows_are_the_model_and_the_references_plain_vggt(small_config: ModelConfig, small_variables: dict) -> None:
    """Where a chunk holds the whole clip."""
    model = LogVGGT(small_config)
    checkpoint = Checkpoint(model, small_variables, "digest")
    rows = [model_row(name, checkpoint, settings) for name, settings in SETTINGS.items()]
    assert [row.name for row in rows] == ["LoG-VGGT", "VGGT offline", "VGGT on chunks"]
    whole = jax.tree.map(lambda x: x[0], jax.jit(model.apply)(small_variables, IMAGES[None]))
    plain = predict_plain(model, small_variables, IMAGES[:FEW])
    for row, expected, count in zip(rows, (whole, plain, plain), (len(IMAGES), FEW, FEW), strict=True):
        prediction = row.predict(IMAGES[:count])
        for name in ("depth", "extrinsics", "intrinsics"):
            np.testing.assert_allclose(getattr(prediction, name), getattr(expected, name), rtol=1e-4, atol=2e-5)


def test_rows_differ_by_method_parameters_and_settings(small_config: ModelConfig) -> None:
    def identities(digest: str, settings: dict[str, Any]) -> list[str]:
        checkpoint = Checkpoint(LogVGGT(small_config), {}, digest)
        return [str(model_row(name, checkpoint, each).identity) for name, each in settings.items()]

    first = identities("a", SETTINGS)
    assert len(set(first)) == len(SETTINGS) and not set(first) & set(identities("b", SETTINGS))
    same = [a == b for a, b in zip(first, identities("a", {**SETTINGS, "chunks": ChunkPlan(6, 2)}), strict=True)]
    assert same == [name != "chunks" for name in SETTINGS]


def test_a_line_of_the_registry_is_a_row(small_config: ModelConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclasses.dataclass(frozen=True)
    class Settings:
        gap: int = 1

    monkeypatch.setitem(
        METHODS, "mine", Method("My method", lambda *given: given[2], Settings, "vggt", "skips", lambda *_: None)
    )
    checkpoint = Checkpoint(LogVGGT(small_config), {}, "")
    row = model_row("mine", checkpoint, Settings(gap=2))
    assert (row.name, row.knows) == ("My method", "its training; skips (gap=2)")
    assert row.start is not None and row.start() == Settings(gap=2)
    assert model_row("mine", checkpoint).knows == "its training; skips"


def test_a_clip_beyond_the_limit_is_refused(small_config: ModelConfig) -> None:
    row = model_row("offline", Checkpoint(LogVGGT(small_config), {"params": {}}, ""), OfflineSettings(max_frames=5))
    with pytest.raises(PredictionError, match="6 frames exceeds max_frames=5"):
        row.predict(IMAGES)
