"""Relative pose errors and accuracies against stored values of the public reference code."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as number_arrays

from logvggt_jax.geometry import compose, quaternion_to_matrix
from logvggt_jax.metrics import pose_accuracy, relative_pose_errors

FAMILY = "relpose"
POSE_CASES = (
    "noisy_small",
    "noisy_large",
    "perfect",
    "gauge_sim3",
    "mirrored_translation",
    "gt_pure_rotation",
    "pred_zero_translation",
    "identical_cameras_both",
    "identical_gt_noisy_pred",
    "random_unrelated",
    "two_frames_a",
    "two_frames_b",
    "two_frames_c",
    "two_frames_d",
    "two_frames_e",
)


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = quaternion_to_matrix(rng.normal(size=(count, 4)))
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return poses


def assert_accuracies(
    rotation: np.ndarray, translation: np.ndarray, expected: dict[str, float], tolerance: float
) -> None:
    for threshold in (3, 5, 15, 30):
        actual = pose_accuracy(rotation, translation, threshold)
        assert actual["auc"] == pytest.approx(expected[f"AUC@{threshold}"], abs=tolerance)
        for name in ("RRA", "RTA"):
            if f"{name}@{threshold}" in expected:
                assert actual[name.lower()] == pytest.approx(expected[f"{name}@{threshold}"], abs=tolerance)


@pytest.mark.parametrize("name", POSE_CASES)
def test_errors_and_accuracies_equal_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    rotation, translation = relative_pose_errors(arrays[f"{name}/pred_w2c"], arrays[f"{name}/gt_w2c"])
    tolerance = cases[name]["tol_deg"]
    np.testing.assert_allclose(rotation, arrays[f"{name}/r_err_deg"], atol=tolerance, rtol=0)
    # A camera that stands still up to round-off has no direction of translation to compare.
    if name != "identical_gt_noisy_pred":
        np.testing.assert_allclose(translation, arrays[f"{name}/t_err_deg"], atol=tolerance, rtol=0)
    assert_accuracies(rotation, translation, cases[name]["expected"], 1e-9)


@pytest.mark.parametrize("name", ["auc_edges", "auc_mix"])
def test_area_under_the_curve_equals_the_reference_at_bin_edges(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    case = cases[name]
    assert_accuracies(arrays[f"{name}/r_err_deg"], arrays[f"{name}/t_err_deg"], case["expected"], case["tol_abs"])


def test_categories_weigh_alike(golden: tuple[dict[str, Any], Any]) -> None:
    cases, arrays = golden
    areas = [pose_accuracy(arrays[f"category_mean/r{i}"], arrays[f"category_mean/t{i}"])["auc"] for i in range(3)]
    expected = [category["AUC30"] for category in cases["category_mean"]["per_category"]]
    assert areas == pytest.approx(expected, abs=1e-9)
    assert np.mean(areas) == pytest.approx(cases["category_mean"]["expected"]["mean_AUC30"], abs=1e-9)


errors = number_arrays(np.float64, st.integers(1, 40), elements=st.floats(0, 180))


@given(rotation=errors, seed=st.integers(0, 1000), threshold=st.integers(1, 60))
@settings(deadline=None, max_examples=200)
def test_area_is_at_most_both_accuracies(rotation: np.ndarray, seed: int, threshold: int) -> None:
    translation = np.random.default_rng(seed).uniform(0, 90, rotation.shape)
    accuracy = pose_accuracy(rotation, translation, threshold)
    # The last bin is closed: an error of exactly the threshold counts in the area and not in the accuracy.
    closed = min(np.mean(rotation <= threshold), np.mean(translation <= threshold))
    assert accuracy["auc"] <= closed + 1e-12
    if not (rotation == threshold).any():
        assert accuracy["auc"] <= min(accuracy["rra"], accuracy["rta"]) + 1e-12


@given(seed=st.integers(0, 10_000), scale=st.floats(0.05, 20.0))
@settings(deadline=None, max_examples=30)
def test_a_similarity_of_the_world_changes_nothing(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    true, predicted, motion = random_poses(rng, 5), random_poses(rng, 5), random_poses(rng, 1)
    moved = compose(predicted, motion)
    moved[:, :3, 3] *= scale
    base = relative_pose_errors(predicted, true)
    other = relative_pose_errors(moved, true)
    np.testing.assert_allclose(other[0], base[0], atol=1e-6)
    np.testing.assert_allclose(other[1], base[1], atol=1e-5)


def test_pairs_come_in_lexicographic_order() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    turned = poses.copy()
    turned[1, :3, :3] = quaternion_to_matrix(np.array([0.0, 0.0, np.sin(0.1), np.cos(0.1)]))
    rotation, _ = relative_pose_errors(turned[:, :3], poses)
    # (0,1) (0,2) (0,3) (1,2) (1,3) (2,3): only those with frame 1 see its 0.2 rad.
    np.testing.assert_allclose(rotation, np.degrees([0.2, 0, 0, 0.2, 0.2, 0]), atol=1e-6)


def test_a_pose_that_is_not_finite_is_named() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    broken = poses.copy()
    broken[2, 0, 3] = np.nan
    with pytest.raises(ValueError, match="predicted_extrinsics: the pose of frame 2 is not finite"):
        relative_pose_errors(broken, poses)
    with pytest.raises(ValueError, match="true_extrinsics: the pose of frame 2"):
        relative_pose_errors(poses, broken)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((1, 4, 4), (1, 4, 4)), "at least 2 frames"),
        (((3, 4, 4), (2, 4, 4)), "3 predicted poses, 2 true"),
        (((3, 3, 3), (3, 4, 4)), r"\[N, 3, 4\] or \[N, 4, 4\]"),
    ],
)
def test_bad_shapes_are_named(shapes: tuple[tuple[int, ...], tuple[int, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        relative_pose_errors(np.ones(shapes[0]), np.ones(shapes[1]))


@pytest.mark.parametrize(
    ("rotation", "translation", "threshold", "message"),
    [
        ([], [], 30, "one length"),
        ([1.0], [1.0, 2.0], 30, "one length"),
        ([np.nan], [1.0], 30, "NaN"),
        ([1.0], [1.0], 0, "positive whole number"),
        ([1.0], [1.0], 2.5, "positive whole number"),
        ([1.0], [1.0], np.nan, "positive whole number"),
        ([1.0], [1.0], np.inf, "positive whole number"),
    ],
)
def test_bad_errors_are_refused(rotation: list[float], translation: list[float], threshold: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pose_accuracy(np.array(rotation), np.array(translation), threshold)
