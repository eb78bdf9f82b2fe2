"""Trajectory errors against stored values of the public reference code."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logvggt_jax.geometry import invert, quaternion_to_matrix, umeyama
from logvggt_jax.metrics import NotMeasurable, trajectory_errors
from logvggt_jax.metrics.trajectory import align_trajectory, rms_radius

FAMILY = "trajectory"
KEYS = {"ate": "ate_rmse", "rpe_translation": "rpe_trans_rmse", "rpe_rotation": "rpe_rot_deg_rmse"}
CASES = (
    "noisy",
    "sim3_exact",
    "sim3_noisy",
    "drift",
    "planar",
    "collinear_exact",
    "collinear_noisy",
    "gt_static",
    "pred_static",
    "three_poses",
    "mirrored",
    "equal_length_bad_times",
    "w2c_used_as_c2w",
)


def spiral(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 5, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = quaternion_to_matrix(rng.normal(size=(count, 4)))
    poses[:, :3, 3] = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=-1)
    return poses


def assert_errors(actual: dict[str, float], expected: dict[str, float], tolerance: float) -> None:
    for ours, theirs in KEYS.items():
        assert actual[ours] == pytest.approx(expected[theirs], abs=tolerance), ours


@pytest.mark.parametrize("name", CASES)
def test_errors_equal_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    expected = cases[name]["expected"]
    predicted, true = arrays[f"{name}/pred_c2w"], arrays[f"{name}/gt_c2w"]
    if "raises" in expected:
        with pytest.raises(NotMeasurable, match="no unique similarity"):
            trajectory_errors(predicted, true)
        return
    assert_errors(trajectory_errors(predicted, true), expected, cases[name]["tol_abs"])


def test_world_to_camera_matrices_give_other_numbers(golden: tuple[dict[str, Any], Any]) -> None:
    cases, arrays = golden
    case = cases["both_w2c"]
    predicted, true = arrays["both_w2c/pred_w2c"], arrays["both_w2c/gt_w2c"]
    assert_errors(trajectory_errors(predicted, true), case["expected"], case["tol_abs"])
    proper = trajectory_errors(invert(predicted), invert(true))
    assert_errors(proper, case["expected"]["proper_c2w"], case["tol_abs"])
    mended = trajectory_errors(arrays["w2c_used_as_c2w/pred_c2w_correct"], arrays["w2c_used_as_c2w/gt_c2w"])
    assert_errors(mended, cases["w2c_used_as_c2w"]["expected"]["with_correct_inverse"], 1e-6)


@pytest.mark.parametrize("name", ["umeyama_points", "umeyama_reflect"])
def test_alignment_equals_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    similarity = umeyama(arrays[f"{name}/x"], arrays[f"{name}/y"])
    tolerance = cases[name]["tol_abs"]
    assert similarity.scale == pytest.approx(float(arrays[f"{name}/s"]), abs=tolerance)
    np.testing.assert_allclose(similarity.rotation, arrays[f"{name}/R"], atol=tolerance)
    np.testing.assert_allclose(similarity.translation, arrays[f"{name}/t"], atol=tolerance)
    assert np.linalg.det(similarity.rotation) == pytest.approx(1.0)


@given(seed=st.integers(0, 10_000), scale=st.floats(1e-4, 1e4))
@settings(deadline=None, max_examples=20)
def test_a_similarity_of_the_prediction_changes_nothing(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    true = spiral(8)
    predicted = true.copy()
    predicted[:, :3, 3] += rng.normal(0, 0.05, (8, 3))
    rotation = quaternion_to_matrix(rng.normal(size=4))
    moved = predicted.copy()
    moved[:, :3, :3] = rotation @ predicted[:, :3, :3]
    moved[:, :3, 3] = scale * predicted[:, :3, 3] @ rotation.T + rng.normal(size=3)
    base, other = trajectory_errors(predicted, true), trajectory_errors(moved, true)
    for key, value in base.items():
        assert other[key] == pytest.approx(value, rel=1e-6, abs=1e-8)


def test_an_exact_similarity_is_undone() -> None:
    true = spiral(9)
    moved = true.copy()
    moved[:, :3, 3] = 0.2 * true[:, :3, 3] + 5.0
    np.testing.assert_allclose(align_trajectory(moved[:, :3], true), true, atol=1e-12)


def test_single_precision_poses_are_accepted() -> None:
    true = spiral(30)
    errors = trajectory_errors(true.astype(np.float32), true)
    assert errors["ate"] < 1e-6 and errors["rpe_rotation"] < 1e-3


def test_arguments_are_left_as_they_are() -> None:
    true, predicted = spiral(6), spiral(6, seed=1)
    before = true.copy(), predicted.copy()
    trajectory_errors(predicted, true)
    np.testing.assert_array_equal(true, before[0])
    np.testing.assert_array_equal(predicted, before[1])


def test_radius_is_the_error_of_standing_still() -> None:
    poses = spiral(50)
    positions = poses[:, :3, 3]
    distances = np.linalg.norm(positions - positions.mean(0), axis=1)
    assert rms_radius(positions) == pytest.approx(np.sqrt((distances**2).mean()))


def test_a_pose_that_is_not_finite_is_named() -> None:
    true = spiral(5)
    broken = true.copy()
    broken[3, 1, 1] = np.inf
    with pytest.raises(NotMeasurable, match="predicted_poses: the pose of frame 3 is not finite"):
        trajectory_errors(broken, true)


def test_two_poses_have_no_alignment() -> None:
    with pytest.raises(NotMeasurable, match="at least 3"):
        trajectory_errors(spiral(2), spiral(2))


def test_unequal_lengths_are_a_fault_of_the_caller() -> None:
    with pytest.raises(ValueError, match="4 predicted and 5 true poses") as raised:
        trajectory_errors(spiral(4), spiral(5))
    assert not isinstance(raised.value, NotMeasurable)
