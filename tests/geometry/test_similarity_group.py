"""Sim(3): exponential and logarithm against a power series and each other, derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest

from logvggt_jax.geometry import (
    Similarity,
    log_derivative,
    quaternion_to_matrix,
    scale_of,
    similarity_adjoint,
    similarity_exp,
    similarity_log,
)


@pytest.fixture(scope="module")
def tangents() -> np.ndarray:
    """[40, 7], among them none, those without turn or without scale, tiny ones, and nearly half a turn."""
    found = np.random.default_rng(0).normal(size=(40, 7))
    found[0] = 0.0
    found[1, 3:6] = 0.0
    found[2, 6] = 0.0
    found[3] *= 1e-7
    found[4, 3:6] *= 1e-5
    found[5, 3:6] *= 3.1 / np.linalg.norm(found[5, 3:6])
    return found


def by_series(tangent: np.ndarray) -> np.ndarray:
    x, y, z = tangent[3:6]
    generator = np.zeros((4, 4))
    generator[:3, :3] = tangent[6] * np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    generator[:3, 3] = tangent[:3]
    total, term = np.eye(4), np.eye(4)
    for power in range(1, 60):
        term = term @ generator / power
        total = total + term
    return total


def test_the_exponential_is_that_of_the_generator(tangents: np.ndarray) -> None:
    np.testing.assert_allclose(similarity_exp(tangents), [by_series(each) for each in tangents], atol=1e-12)


def test_the_logarithm_undoes_it(tangents: np.ndarray) -> None:
    np.testing.assert_allclose(similarity_log(similarity_exp(tangents)), tangents, atol=1e-12)
    np.testing.assert_allclose(scale_of(similarity_exp(tangents)), np.exp(tangents[:, 6]))


def test_the_adjoint_carries_tangents(tangents: np.ndarray) -> None:
    matrix = similarity_exp(tangents[7])
    moved = matrix @ similarity_exp(tangents) @ np.linalg.inv(matrix)
    carried = (similarity_adjoint(matrix) @ tangents[..., None])[..., 0]
    np.testing.assert_allclose(similarity_exp(carried), moved, atol=1e-12)


def test_the_derivative_is_the_limit_of_differences(tangents: np.ndarray) -> None:
    step = 1e-5
    columns = []
    for direction in step * np.eye(7):
        ahead, back = (
            similarity_log(similarity_exp(tangents) @ similarity_exp(sign * direction)) for sign in (1.0, -1.0)
        )
        columns.append((ahead - back) / (2 * step))
    np.testing.assert_allclose(log_derivative(tangents), np.stack(columns, axis=-1), rtol=1e-5, atol=1e-6)


def test_a_similarity_as_a_matrix() -> None:
    similarity = Similarity(2.5, quaternion_to_matrix(np.array([0.1, 0.3, -0.2, 0.9])), np.array([1.0, -2.0, 0.5]))
    points = np.random.default_rng(1).normal(size=(5, 3))
    homogeneous = np.concatenate([points, np.ones((5, 1))], axis=1)
    np.testing.assert_allclose((homogeneous @ similarity.matrix.T)[:, :3], similarity.apply(points))
