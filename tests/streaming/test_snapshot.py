"""A stream that goes on from a snapshot gives what it would have given, bit for bit, whichever the method."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.config import RefinementConfig
from logvggt_jax.streaming import (
    METHODS,
    AnchoredWindowSettings,
    CausalSettings,
    ChunkPlan,
    FrameResult,
    LoopSettings,
    Predictor,
    PrunedSettings,
    RollingSettings,
    WindowSettings,
    open_predictor,
)

COUNT = 11
# Sizes of caches are those of `test_frame_methods.py`, with which the programs are shared: three frames, and a bit.
SMALL_CAP, SMALL_BUDGET = 3 * 11 + 2, 3 * 11 * 4
LOOPS = LoopSettings(spacing=2, gap=4, similarity=-1.0, frames=1)
CASES = {
    "windows": ("windows", None, RefinementConfig()),
    "online windows": ("windows", None, RefinementConfig(period=2, context=4)),
    "bounded windows": ("windows", None, RefinementConfig(period=2, context=4, max_registers=8)),
    "windows without refinement": ("windows", None, RefinementConfig(enabled=False)),
    "windows with loops": ("windows", WindowSettings(loops=LOOPS), RefinementConfig()),
    "chunks": ("chunks", ChunkPlan(4, 2), RefinementConfig()),
    "chunks with loops": ("chunks", ChunkPlan(4, 2, LOOPS), RefinementConfig()),
    "offline": ("offline", None, RefinementConfig()),
    "merged": ("merged", None, RefinementConfig()),
    "causal": ("causal", CausalSettings(first_capacity=2), RefinementConfig()),
    "causal with one camera cache": ("causal", CausalSettings("single"), RefinementConfig(enabled=False)),
    "anchored-window": ("anchored-window", AnchoredWindowSettings(window=2), RefinementConfig()),
    "pruned": ("pruned", PrunedSettings(SMALL_CAP, first_capacity=2), RefinementConfig()),
    "pruned in 16 bits": ("pruned", PrunedSettings(SMALL_CAP, 16, "single"), RefinementConfig(enabled=False)),
    "rolling": ("rolling", RollingSettings(SMALL_BUDGET, first_capacity=2), RefinementConfig()),
}
# A method of which nothing else is to be shown goes on with its own defaults.
CASES |= {name: (name, None, RefinementConfig()) for name in METHODS.keys() - {method for method, *_ in CASES.values()}}
# Sessions and states that other cases have as well.
MORE = ("merged", "causal with one camera cache", "pruned in 16 bits")


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (COUNT, 28, 42, 3), np.uint8)


def _numbers(results: list[FrameResult]) -> list[tuple]:
    return [(result.index, result.depth.tobytes(), result.confidence.tobytes()) for result in results]


def _through_a_file(arrays: dict[str, np.ndarray], file: Path) -> dict[str, np.ndarray]:
    save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, file)
    return load_file(file)


@pytest.mark.parametrize("case", [pytest.param(name, marks=[pytest.mark.slow] * (name in MORE)) for name in CASES])
def test_a_stream_goes_on_from_a_snapshot(
    case: str, small_config: ModelConfig, small_variables: dict, frames: np.ndarray, tmp_path: Path
) -> None:
    method, settings, refinement = CASES[case]
    model = LogVGGT(dataclasses.replace(small_config, refinement=dataclasses.replace(refinement, num_heads=2)))

    def opened() -> Predictor:
        return open_predictor(method, model, small_variables, settings)

    if method == "offline":
        # All of them at once and nothing before: as many as other tests have, whose program is the same.
        frames = frames[:4]
    straight = opened()
    expected = [result for frame in frames for result in straight.push(frame)] + straight.close()

    # Before the first frame, before and after the first window, and with frames that no window holds yet.
    predictor: Any = opened()
    results: list[FrameResult] = []
    for index, frame in enumerate(frames):
        if index in (0, 1, 2, 5, 8):
            final, arrays = predictor.snapshot()
            results += final
            predictor = opened()
            predictor.restore(_through_a_file(arrays, tmp_path / f"{index}.safetensors"))
            assert predictor.num_frames == len(results)
        results += predictor.push(frame)
    results += predictor.close()

    assert _numbers(results) == _numbers(expected)
    assert len(results) == len(frames)
    for name, array in straight.cameras()._asdict().items():
        np.testing.assert_array_equal(getattr(predictor.cameras(), name), array, err_msg=name)
