"""Rotations: quaternions, matrices and angles, against their definitions and at the awkward places."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.geometry import (
    is_rotation,
    matrix_to_quaternion,
    nearest_rotation,
    quaternion_to_matrix,
    rotation_angle,
)


def axis_angle(axis, angle: float) -> np.ndarray:
    """Rodrigues' formula, float64."""
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def quaternions(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 4))


def test_matrices_are_rotations_whatever_the_quaternions_length() -> None:
    matrices = quaternion_to_matrix(quaternions())
    np.testing.assert_allclose(matrices @ matrices.swapaxes(-1, -2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0)
    np.testing.assert_allclose(quaternion_to_matrix(7.0 * quaternions()), matrices, atol=1e-12)


def test_order_is_x_y_z_w() -> None:
    half = 0.35
    quaternion = np.array([np.sin(half), 0.0, 0.0, np.cos(half)])
    np.testing.assert_allclose(quaternion_to_matrix(quaternion), axis_angle([1, 0, 0], 0.7), atol=1e-12)


def test_there_and_back() -> None:
    unit = quaternions() / np.linalg.norm(quaternions(), axis=-1, keepdims=True)
    found = matrix_to_quaternion(quaternion_to_matrix(unit))
    assert (found[:, 3] >= 0).all()
    np.testing.assert_allclose(found, unit * np.sign(unit[:, 3:]), atol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3)])
@pytest.mark.parametrize("angle", [0.0, 1e-6, np.pi - 1e-6, np.pi])
def test_half_turns_and_the_identity_keep_their_accuracy(axis, angle: float) -> None:
    matrix = axis_angle(axis, angle).astype(np.float32)
    np.testing.assert_allclose(quaternion_to_matrix(matrix_to_quaternion(matrix)), matrix, atol=2e-6)


@jax.jit
def rotation_gradients(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gradients by a matrix of its quaternion's sum and of its angle; one program for all matrices."""
    quaternion = jax.grad(lambda m: matrix_to_quaternion(m).sum())(matrix)
    return quaternion, jax.grad(lambda m: rotation_angle(m, jnp.eye(3)))(matrix)


@pytest.mark.parametrize("angle", [0.0, np.pi])
def test_gradients_are_finite_at_the_identity_and_at_half_turns(angle: float) -> None:
    quaternion, rotation = rotation_gradients(axis_angle([0, 0, 1], angle).astype(np.float32))
    assert np.isfinite(quaternion).all() and np.isfinite(rotation).all()


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.3, 3.0, np.pi])
def test_angle_between_two_rotations(angle: float) -> None:
    first = quaternion_to_matrix(quaternions(1)[0])
    second = first @ axis_angle([2, -1, 1], angle)
    assert rotation_angle(first, second) == pytest.approx(angle, abs=1e-7)
    single = rotation_angle(np.eye(3, dtype=np.float32), axis_angle([2, -1, 1], angle).astype(np.float32))
    assert single == pytest.approx(angle, abs=1e-6), "the arccosine of a trace would be off by 1e-4 here"


@pytest.mark.parametrize("nearest", [nearest_rotation, jax.jit(nearest_rotation)], ids=["numpy", "jax"])
def test_nearest_rotation(nearest) -> None:
    rotation = axis_angle([1, 2, 3], 0.8)
    noise = 1e-3 * np.random.default_rng(1).normal(size=(3, 3))
    found = np.asarray(nearest(1.7 * rotation + noise))
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found, rotation, atol=2e-3)
    mirrored = np.asarray(nearest(rotation @ np.diag([1.0, 1.0, -0.1])))
    assert np.linalg.det(mirrored) == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(mirrored, rotation, atol=1e-5)


def test_rotations_are_told_from_other_matrices() -> None:
    matrices = quaternion_to_matrix(quaternions())
    assert is_rotation(matrices).all() and is_rotation(matrices.astype(np.float32)).all()
    for other in (-matrices, 1.01 * matrices, np.nan * matrices, np.diag([1, 1, 0.99]) @ matrices):
        assert not is_rotation(other).any()
