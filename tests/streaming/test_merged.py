"""VGGT offline with merged tokens: plain VGGT where nothing is merged, and cheaper where something is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.streaming import MergedSession, MergedSettings, OfflineSession, OfflineSettings
from logvggt_jax.streaming.merged import merged_program
from logvggt_jax.streaming.offline import offline_program

IMAGES = np.random.default_rng(0).integers(0, 256, (4, 28, 42, 3), np.uint8)


def _predicted(session: OfflineSession, images: np.ndarray) -> list[np.ndarray]:
    results = [*session.push(images), *session.close()]
    return [np.stack([getattr(result, name) for result in results]) for name in ("depth", "confidence")] + [
        session.cameras().pose_encoding
    ]


def test_nothing_merged_is_plain_vggt(small_config: ModelConfig, small_variables: dict) -> None:
    model = LogVGGT(small_config)
    plain = _predicted(OfflineSession(model, small_variables, OfflineSettings()), IMAGES)
    none = _predicted(MergedSession(model, small_variables, MergedSettings(ratio=0)), IMAGES)
    merged = _predicted(MergedSession(model, small_variables, MergedSettings()), IMAGES)
    for expected, found, other in zip(plain, none, merged, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
        assert np.abs(other - expected).max() > 1e-3


def test_one_frame_has_nothing_to_merge(small_config: ModelConfig, small_variables: dict) -> None:
    model = LogVGGT(small_config)
    plain = _predicted(OfflineSession(model, small_variables, OfflineSettings()), IMAGES[:1])
    merged = _predicted(MergedSession(model, small_variables, MergedSettings()), IMAGES[:1])
    for expected, found in zip(plain, merged, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_merging_costs_less(small_config: ModelConfig) -> None:
    model, frames = LogVGGT(small_config), 40
    plain = offline_program(model, (84, 126), OfflineSettings(), frames).flops
    assert merged_program(model, (84, 126), MergedSettings(), frames).flops < 0.7 * plain


@pytest.mark.parametrize(
    ("field", "value"), [("ratio", 1.5), ("ratio", -0.1), ("protected", 2), ("similarity", "int8"), ("max_frames", 0)]
)
def test_settings_that_mean_nothing_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"MergedSettings.{field} must"):
        MergedSettings(**{field: value})
