"""The training log, validation and evaluation agree on what an error is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.geometry import quaternion_to_matrix
from logvggt_jax.metrics import depth_metrics, relative_pose_errors
from logvggt_jax.training.losses import clip_errors

# As programs, which training runs: one by one each operation would compile by itself.
depth_errors, pose_errors = jax.jit(clip_errors.depth_errors), jax.jit(clip_errors.pose_errors)


def _cameras(seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    cameras = np.tile(np.eye(4), (2, 5, 1, 1))
    cameras[..., :3, :3] = quaternion_to_matrix(generator.normal(size=(2, 5, 4)) + np.array([0, 0, 0, 2.0]))
    cameras[..., :3, 3] = generator.normal(size=(2, 5, 3))
    return cameras.astype(np.float32)


def test_pose_errors_are_those_of_the_evaluation() -> None:
    predicted, true = _cameras(0), _cameras(1)
    predicted[0, :, :3, 3] = -true[0, :, :3, 3]  # angles above 90 degrees without their sign
    found = pose_errors(jnp.asarray(predicted), jnp.asarray(true), jnp.ones((2, 5), bool))
    still = np.tile(np.eye(4), (5, 1, 1))
    expected = [relative_pose_errors(*pair) for pair in zip(predicted, true, strict=True)]
    identity = [relative_pose_errors(still, each)[0] for each in true]
    assert float(found["rotation"].value()) == pytest.approx(np.mean([e[0] for e in expected]), abs=1e-2)
    assert float(found["identity_rotation"].value()) == pytest.approx(np.mean(identity), abs=1e-2)
    assert float(found["translation_direction"].value()) == pytest.approx(np.mean([e[1] for e in expected]), abs=1e-2)


def test_direction_has_no_sign_and_needs_motion() -> None:
    true = _cameras(2)
    true[..., :3, :3] = np.eye(3)
    valid = jnp.ones((2, 5), bool)
    for factor, degrees in ((1.0, 0.0), (-3.0, 0.0), (0.0, 90.0)):
        predicted = true.copy()
        predicted[..., :3, 3] *= factor
        found = pose_errors(jnp.asarray(predicted), jnp.asarray(true), valid)
        assert float(found["translation_direction"].value()) == pytest.approx(degrees, abs=0.1)


@pytest.mark.parametrize("odd", [False, True])
def test_depth_errors_are_those_of_the_evaluation(odd: bool) -> None:
    generator = np.random.default_rng(5)
    target = generator.uniform(1, 9, (1, 2, 6, 7)).astype(np.float32)
    depth = (0.2 * target * generator.uniform(0.5, 1.5, target.shape)).astype(np.float32)
    valid = generator.random(target.shape) < 0.6
    valid.flat[np.flatnonzero(valid)[: (valid.sum() % 2) ^ odd]] = False
    target[~valid] = 0.0
    found = depth_errors(*map(jnp.asarray, (depth, target, valid)))
    expected = depth_metrics(depth, target, alignment="median")
    assert expected["valid_pixels"] % 2 == odd
    for name, error in found.items():
        assert float(error.value()) == pytest.approx(expected[name], rel=1e-5)


def test_each_clip_is_aligned_alone_and_one_without_depth_counts_for_nothing() -> None:
    target = jnp.asarray(np.random.default_rng(6).uniform(1, 9, (3, 1, 4, 5)))
    depth = target * jnp.asarray([0.5, 3.0, 1.0])[:, None, None, None]
    valid = jnp.asarray([True, True, False])[:, None, None, None] & jnp.ones(target.shape, bool)
    found = depth_errors(depth, jnp.where(valid, target, 0.0), valid)
    assert float(found["abs_rel"].value()) == pytest.approx(0.0, abs=1e-6)
    assert float(found["delta_1.25"].value()) == 1.0


def test_padded_frames_form_no_pairs() -> None:
    predicted, true = _cameras(3), _cameras(4)
    valid = np.array([[True] * 3 + [False] * 2, [True] + [False] * 4])
    found = pose_errors(jnp.asarray(predicted), jnp.asarray(true), jnp.asarray(valid))
    assert float(found["rotation"].denominator) == 3
    alone = pose_errors(jnp.asarray(predicted[:1, :3]), jnp.asarray(true[:1, :3]), jnp.ones((1, 3), bool))
    assert float(found["rotation"].value()) == pytest.approx(float(alone["rotation"].value()), rel=1e-6)
