"""Pose errors over pairs of frames."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.evaluation import relative_pose_errors
from logvggt_jax.geometry import quaternion_to_matrix
from logvggt_jax.training.pose_errors import pairwise_pose_errors


def _cameras(seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    cameras = np.tile(np.eye(4), (2, 5, 1, 1))
    cameras[..., :3, :3] = quaternion_to_matrix(generator.normal(size=(2, 5, 4)) + np.array([0, 0, 0, 2.0]))
    cameras[..., :3, 3] = generator.normal(size=(2, 5, 3))
    return cameras.astype(np.float32)


def test_rotation_is_that_of_the_evaluation() -> None:
    predicted, true = _cameras(0), _cameras(1)
    found = pairwise_pose_errors(jnp.asarray(predicted), jnp.asarray(true), jnp.ones((2, 5), bool))
    still = np.tile(np.eye(4), (5, 1, 1))
    rotation = [relative_pose_errors(*pair)[0] for pair in zip(predicted, true, strict=True)]
    identity = [relative_pose_errors(still, each)[0] for each in true]
    assert float(found["rotation"].value()) == pytest.approx(np.mean(rotation), abs=1e-2)
    assert float(found["identity_rotation"].value()) == pytest.approx(np.mean(identity), abs=1e-2)


def test_direction_is_zero_when_right_and_180_when_reversed() -> None:
    true = _cameras(2)
    true[..., :3, :3] = np.eye(3)
    reversed_ = true.copy()
    reversed_[..., :3, 3] *= -3.0
    valid = jnp.ones((2, 5), bool)
    same = pairwise_pose_errors(jnp.asarray(true), jnp.asarray(true), valid)
    opposite = pairwise_pose_errors(jnp.asarray(reversed_), jnp.asarray(true), valid)
    assert float(same["translation_direction"].value()) == pytest.approx(0.0, abs=0.1)
    assert float(opposite["translation_direction"].value()) == pytest.approx(180.0, abs=0.1)


def test_padded_frames_form_no_pairs() -> None:
    predicted, true = _cameras(3), _cameras(4)
    valid = np.array([[True] * 3 + [False] * 2, [True] + [False] * 4])
    found = pairwise_pose_errors(jnp.asarray(predicted), jnp.asarray(true), jnp.asarray(valid))
    assert float(found["rotation"].denominator) == 3
    alone = pairwise_pose_errors(jnp.asarray(predicted[:1, :3]), jnp.asarray(true[:1, :3]), jnp.ones((1, 3), bool))
    assert float(found["rotation"].value()) == pytest.approx(float(alone["rotation"].value()), rel=1e-6)
