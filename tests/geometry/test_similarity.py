"""Similarity transforms: exact where the points fit, robust where some do not, refused where none exists."""

import numpy as np
import pytest

from logvggt_jax.geometry import (
    NoSimilarity,
    Similarity,
    as_matrix,
    pose_similarity,
    quaternion_to_matrix,
    robust_similarity,
    transform_points,
    umeyama,
)

TRUTH = Similarity(2.5, quaternion_to_matrix(np.array([0.3, -0.5, 0.2, 0.8])), np.array([1.0, -2.0, 3.0]))


def points(count: int = 50) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3))


def assert_same(found: Similarity, expected: Similarity, tolerance: float = 1e-10) -> None:
    assert found.scale == pytest.approx(expected.scale, rel=tolerance)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=tolerance)
    np.testing.assert_allclose(found.translation, expected.translation, atol=10 * tolerance)


@pytest.mark.parametrize("count", [3, 50])
@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_exact_correspondences_give_the_transform(count: int, size: float) -> None:
    source = size * points(count)
    found = umeyama(source, TRUTH.apply(source))
    assert_same(found, TRUTH, 1e-8)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_a_mirrored_cloud_still_gives_a_rotation() -> None:
    found = umeyama(points(), points() * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0) and found.scale > 0


def test_points_without_weight_have_no_influence() -> None:
    target = TRUTH.apply(points())
    target[:10] += 100.0
    assert_same(umeyama(points(), target, np.arange(50) >= 10), TRUTH)


def test_outliers_move_the_robust_transform_less() -> None:
    target = TRUTH.apply(points())
    target[:5] += 3.0
    robust, plain = robust_similarity(points(), target, threshold=0.05, iterations=20), umeyama(points(), target)
    inliers = slice(5, None)

    def error(similarity: Similarity) -> float:
        return float(np.abs(similarity.apply(points()[inliers]) - target[inliers]).max())

    assert error(robust) < 0.1 * error(plain)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (points(2), "at least 3 corresponding points, got 2"),
        (np.ones((5, 3)), "no unique similarity"),
        (np.arange(5.0)[:, None] * [1.0, 2.0, 3.0], "no unique similarity"),
        (points(5) * np.nan, "no similarity: a point or weight is not finite"),
    ],
)
def test_degenerate_points_are_refused(source: np.ndarray, message: str) -> None:
    with pytest.raises(NoSimilarity, match=message) as error:
        umeyama(source, source)
    assert "\n" not in str(error.value)


def test_arrays_of_wrong_shapes_are_the_callers_fault() -> None:
    with pytest.raises(ValueError, match=r"two .* arrays") as error:
        umeyama(points(5), points(4))
    assert not isinstance(error.value, NoSimilarity)


def test_cameras_move_with_their_world() -> None:
    """A point's place in a camera is the same as before, in the new unit."""
    pose = np.concatenate([quaternion_to_matrix(np.array([0.1, 0.7, 0.2, -0.4])), [[0.5], [-1.0], [2.0]]], axis=1)
    moved = TRUTH.apply_to_extrinsics(pose)
    seen, before = transform_points(moved, TRUTH.apply(points())), transform_points(pose, points())
    np.testing.assert_allclose(seen, TRUTH.scale * before, atol=1e-12)
    np.testing.assert_allclose(TRUTH.apply_to_extrinsics(as_matrix(pose)), as_matrix(moved), atol=1e-12)


def cameras(centres: np.ndarray) -> np.ndarray:
    rotations = quaternion_to_matrix(np.random.default_rng(1).normal(size=(len(centres), 4)))
    return np.concatenate([rotations, -(rotations @ centres[:, :, None])], axis=2)


@pytest.mark.parametrize("straight", [False, True])
def test_cameras_give_the_transform_even_on_a_straight_path_and_with_wrong_ones_among_them(straight: bool) -> None:
    source = cameras(np.arange(30.0)[:, None] * [1.0, 0.5, 0.2] if straight else points(30))
    target = TRUTH.apply_to_extrinsics(source)
    assert_same(pose_similarity(source, target), TRUTH, 1e-8)
    target[::4] = cameras(5 * points(30)[::4])
    assert_same(pose_similarity(source, target), TRUTH, 1e-4)


def test_cameras_at_one_place_have_no_scale() -> None:
    with pytest.raises(NoSimilarity, match="all at one place"):
        pose_similarity(cameras(np.ones((5, 3))), cameras(points(5)))
    with pytest.raises(NoSimilarity, match="at least 2"):
        pose_similarity(cameras(points(1)), cameras(points(1)))
