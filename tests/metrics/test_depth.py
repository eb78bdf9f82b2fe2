"""Depth errors against stored values of the public reference code, and their invariances."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as number_arrays

from logvggt_jax.metrics import depth as depth_module
from logvggt_jax.metrics import depth_metrics
from logvggt_jax.metrics.depth import DEPTH_KEYS, align_depth, lower_median, mean_depth_metrics, resize_depth

FAMILY = "depth"
REFERENCE_NAMES = {"scale_shift_lad_adam": "scale_shift"}
CASES = (
    "sintel_like",
    "bonn_like",
    "kitti_like",
    "exact_scale",
    "exact_scale_shift",
    "outliers_10pct",
    "nonpositive_pred",
    "median_even_count",
    "single_valid",
    "all_invalid",
    "mask_boundaries",
    "custom_mask",
    "nan_pred",
)


@pytest.mark.parametrize("name", CASES)
def test_errors_equal_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    case = cases[name]
    mask = arrays[f"{name}/custom_mask"] if name == "custom_mask" else None
    compared = 0
    for alignment, expected in case["expected_by_alignment"].items():
        if expected["informational"]:
            continue
        actual = depth_metrics(
            arrays[f"{name}/pred"],
            arrays[f"{name}/gt"],
            alignment=REFERENCE_NAMES.get(alignment, alignment),
            max_depth=case["params"]["max_depth"],
            clip=case["params"].get("post_clip_max"),
            mask=mask,
        )
        assert actual["valid_pixels"] == expected["valid_pixels"]
        for key in DEPTH_KEYS:
            tolerance = (
                {"abs": expected["tol_delta_abs"], "rel": 0}
                if key.startswith("delta")
                else {"abs": expected["tol_abs"], "rel": expected["tol_rel"]}
            )
            value = pytest.approx(float(expected[key]), **tolerance, nan_ok=True)
            assert actual[key] == value, f"{alignment} {key}"
        compared += 1
    assert compared


def test_data_set_score_is_weighted_by_valid_pixels(golden: tuple[dict[str, Any], Any]) -> None:
    cases, arrays = golden
    case = cases["aggregate"]
    clips = [
        depth_metrics(arrays[f"aggregate/pred{i}"], arrays[f"aggregate/gt{i}"], alignment="scale", max_depth=70)
        for i in range(3)
    ]
    score = mean_depth_metrics(clips)
    for key in DEPTH_KEYS:
        # The tolerance of each clip's `scale` alignment bounds the mean's.
        assert score[key] == pytest.approx(case["expected_weighted"][key], rel=3e-3), key
    assert score["valid_pixels"] == 276
    stored = mean_depth_metrics(case["per_sequence"])
    for key in DEPTH_KEYS:
        assert stored[key] == pytest.approx(case["expected_weighted"][key], rel=case["tol_rel"])


def test_score_of_nothing_is_nan() -> None:
    assert np.isnan(mean_depth_metrics([])["abs_rel"])


@pytest.mark.parametrize("name", ["resize_up", "resize_down"])
def test_resize_equals_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    expected = arrays[f"{name}/resized"]
    actual = resize_depth(arrays[f"{name}/src"][None], expected.shape)[0]
    np.testing.assert_allclose(actual, expected, atol=cases[name]["tol_abs"], rtol=0)


@given(scale=st.floats(0.01, 100.0), seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=25)
def test_scale_and_median_ignore_the_unit(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = rng.uniform(0.5, 5.0, (2, 6, 7))
    prediction = target * rng.uniform(0.7, 1.4, target.shape)
    for alignment in ("scale", "median", "lstsq"):
        base = depth_metrics(prediction, target, alignment=alignment)
        scaled = depth_metrics(scale * prediction, target, alignment=alignment)
        for key in ("abs_rel", "sq_rel", "rmse", "log_rmse"):
            assert scaled[key] == pytest.approx(base[key], rel=1e-5, abs=1e-9), (alignment, key)


def test_least_squares_leaves_the_smallest_squared_error() -> None:
    rng = np.random.default_rng(0)
    prediction = rng.uniform(1, 4, 200)
    target = 1.7 * prediction + 0.4 + rng.normal(0, 0.1, 200)
    scale, shift = align_depth(prediction, target, "lstsq")
    best = ((scale * prediction + shift - target) ** 2).sum()
    for step_scale, step_shift in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3)):
        moved = (scale + step_scale) * prediction + shift + step_shift
        assert ((moved - target) ** 2).sum() > best


def test_invalid_target_pixels_do_not_count() -> None:
    target = np.full((1, 2, 3), 2.0)
    target[0, 0, 0] = 0.0
    prediction = target.copy()
    prediction[0, 0, 0] = 1e6
    errors = depth_metrics(prediction, target, alignment="metric")
    assert errors["abs_rel"] == 0.0 and errors["valid_pixels"] == 5


@pytest.mark.parametrize("alignment", ["scale", "median", "scale_shift"])
def test_a_prediction_of_zeros_has_no_scale_and_hits_nothing(alignment: str) -> None:
    errors = depth_metrics(np.zeros((1, 4, 5)), np.ones((1, 4, 5)), alignment=alignment)
    assert np.isnan(errors["abs_rel"]) and errors["delta_1.25"] == 0.0


def test_lower_median_takes_the_lower_of_two_middles() -> None:
    assert lower_median(np.array([4.0, 1.0, 3.0, 2.0])) == 2.0
    assert lower_median(np.array([3.0, 1.0, 2.0])) == 2.0
    assert np.isnan(lower_median(np.array([1.0, np.nan, 2.0])))


@given(
    values=number_arrays(
        st.sampled_from([np.float32, np.float64]), st.integers(1, 60), elements=st.floats(-1e6, 1e6, width=32)
    )
)
@settings(deadline=None, max_examples=60)
def test_lower_median_selects_what_sorting_does(values: np.ndarray) -> None:
    assert lower_median(values) == np.sort(values)[(len(values) - 1) // 2]


def test_blocks_give_the_errors_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    target = rng.uniform(0.5, 5.0, (6, 11, 13)).astype(np.float32)
    target[rng.random(target.shape) < 0.3] = 0.0
    prediction = (target + rng.uniform(0.1, 1.0, target.shape)).astype(np.float32)
    mask = rng.random(target.shape) < 0.5
    whole = {name: depth_metrics(prediction, target, alignment=name, mask=mask) for name in ("scale", "median")}
    monkeypatch.setattr(depth_module, "_BLOCK", 17)
    for name, errors in whole.items():
        assert depth_metrics(prediction, target, alignment=name, mask=mask) == pytest.approx(errors, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"alignment": "affine"}, "alignment must be one of"),
        ({"alignment": "metric", "mask": np.ones((1, 2, 3))}, "mask must be bool"),
        ({"alignment": "metric", "mask": np.ones((2, 3), bool)}, "mask must be bool of shape"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        depth_metrics(np.ones((1, 2, 3)), np.ones((1, 2, 3)), **arguments)


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="resize_depth"):
        depth_metrics(np.ones((1, 2, 3)), np.ones((1, 4, 6)), alignment="metric")
