"""Ablation variants: the models they claim to be, on one checkpoint, with shared windows."""

import dataclasses

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, WindowConfig
from logvggt_jax.evaluation.methods import variants as module
from logvggt_jax.evaluation.methods.method import Checkpoint, ClipPrediction
from logvggt_jax.evaluation.methods.variants import VARIANTS, variant_methods
from logvggt_jax.streaming.loops import LoopCloser

FRAMES = 9
IMAGES = np.random.default_rng(0).integers(0, 256, (FRAMES, 28, 42, 3), np.uint8)
NAMES = ("full", "gccr_online", "no_cwa")


@pytest.fixture(scope="module")
def predictions(small_config: ModelConfig, small_variables: dict) -> dict[str, ClipPrediction]:
    methods = variant_methods(Checkpoint(LogVGGT(small_config), small_variables, ""), NAMES)
    return {method.name: method.predict(IMAGES) for method in methods}


@pytest.mark.slow
def test_each_variant_comes_with_both_trunks(predictions: dict[str, ClipPrediction]) -> None:
    labels = [VARIANTS[name].label for name in NAMES]
    assert list(predictions) == [f"{label}, trunk {trunk}" for label in labels for trunk in ("all", "4")]


def test_a_variant_is_the_model_of_its_configuration(
    predictions: dict[str, ClipPrediction], small_config: ModelConfig, small_variables: dict
) -> None:
    settings = dataclasses.replace(small_config.refinement, period=2, context=4)
    model = LogVGGT(dataclasses.replace(small_config, refinement=settings))
    expected = jax.jit(model.apply)(small_variables, IMAGES[None])
    prediction = predictions["GCCR online, trunk 4"]
    np.testing.assert_allclose(prediction.depth, expected.depth[0], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(prediction.extrinsics, expected.extrinsics[0], rtol=1e-3, atol=1e-3)


def test_variants_differ_where_they_should(predictions: dict[str, ClipPrediction]) -> None:
    full = predictions["full, trunk all"]
    assert full.depth is not None
    for name, prediction in predictions.items():
        assert prediction.depth is not None
        same_depth = np.array_equal(prediction.depth, full.depth)
        assert same_depth == (not name.startswith("w/o CWA")), name
        if name != "full, trunk all":
            assert np.abs(prediction.extrinsics - full.extrinsics).max() > 1e-5, name


def test_windows_run_once_for_all_refinements(
    small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = []
    original = module.handed_out
    monkeypatch.setattr(module, "handed_out", lambda session, images: runs.append(images) or original(session, images))
    names = ("full", "no_gccr", "no_cwa")
    methods = variant_methods(Checkpoint(LogVGGT(small_config), small_variables, ""), names)
    for _ in range(2):
        images = IMAGES.copy()
        predictions = {method.name: method.predict(images) for method in methods}
    assert np.abs(predictions["w/o GCCR, trunk 4"].extrinsics - predictions["full, trunk 4"].extrinsics).max() > 1e-5
    assert len(runs) == 2 * 2, "with and without cross-window attention, for either clip"


def test_loops_and_chained_windows_are_rows(
    small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depth and cameras of the variant with loops are those that closing gave, of the others as without it."""
    monkeypatch.setattr(
        LoopCloser, "close", lambda self, cameras: cameras._replace(depth_scale=np.arange(FRAMES) + 1.0)
    )
    names = ("full", "gccr_loops", "windows_chained")
    methods = variant_methods(Checkpoint(LogVGGT(small_config), small_variables, ""), names)
    rows = {method.name: method for method in methods}
    labels = [f"{label}, trunk {trunk}" for label in ("full", "GCCR with loops") for trunk in ("all", "4")]
    assert list(rows) == [*labels, "relative chain of windows"]
    assert len({repr(method.identity) for method in methods}) == 5
    images = IMAGES.copy()
    full, looped = (rows[f"{label}, trunk all"].predict(images) for label in ("full", "GCCR with loops"))
    np.testing.assert_array_equal(looped.extrinsics, full.extrinsics)
    assert full.depth is not None and looped.depth is not None
    np.testing.assert_allclose(looped.depth, full.depth * (np.arange(FRAMES) + 1.0)[:, None, None], rtol=1e-6)
    assert rows["relative chain of windows"].identity[:2] == ["chunks", {"size": 4, "overlap": 2, "loops": False}]


def test_the_same_model_has_one_row(small_config: ModelConfig, small_variables: dict) -> None:
    base = LogVGGT(dataclasses.replace(small_config, windows=WindowConfig(4, 2, cache="input")))
    names = ("full", "cache_input", "cache_output", "windows_4_2")
    rows = [method.name for method in variant_methods(Checkpoint(base, small_variables, ""), names)]
    assert rows == ["full, trunk all", "full, trunk 4", "cache of outputs, trunk all", "cache of outputs, trunk 4"]


def test_the_checkpoint_is_ablated_from_the_full_model(small_config: ModelConfig) -> None:
    """Whatever a checkpoint was trained as, `full` has all parts, and refines once."""
    settings = dataclasses.replace(small_config.refinement, enabled=False, period=50, context=8)
    base = dataclasses.replace(small_config, refinement=settings, windows=WindowConfig(6, 3, cross_window=False))
    full = VARIANTS["full"].config(base)
    assert full.windows == WindowConfig(6, 3) and full.refinement == small_config.refinement
    assert VARIANTS["gccr_online"].config(base, context=6).refinement.period == 3
    assert VARIANTS["gccr_every_50"].config(base).refinement.period == 50


def test_every_variant_is_a_valid_model() -> None:
    configs = {VARIANTS[name].config(ModelConfig(), context=context) for name in VARIANTS for context in (None, 16)}
    # cache_output and windows_4_2 are the full model at the paper's configuration, as are the rows of loops and chains,
    # which differ in what is done with the windows.
    plain = [name for name, variant in VARIANTS.items() if not (variant.loops or variant.chained)]
    assert len(configs) == 2 * (len(plain) - 2)
