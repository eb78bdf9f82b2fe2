"""The paper's losses against formulas written out, and their behaviour at the edges."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.training.losses import log_vggt as losses
from logvggt_jax.training.losses import vggt
from logvggt_jax.training.losses.distillation import distilled_depth_losses
from logvggt_jax.training.losses.mean import Mean

WEIGHTS = {"translation_weight": 1.0, "rotation_weight": 1.0, "field_of_view_weight": 0.5, "gamma": 0.6}
# As programs, which training runs: one by one each operation would compile by itself.
camera_loss = jax.jit(losses.camera_loss, static_argnames=tuple(WEIGHTS))
depth_losses = jax.jit(losses.depth_losses, static_argnames="alpha")


def test_camera_loss_is_the_formula() -> None:
    generator = np.random.default_rng(0)
    predicted, target = generator.normal(size=(2, 3, 4, 9)), generator.normal(size=(2, 3, 9))
    valid = np.array([[True, True, False], [True, False, False]])
    expected = 0.0
    for b, t in zip(*np.nonzero(valid), strict=True):
        for s in range(4):
            error = np.abs(predicted[b, t, s] - target[b, t])
            expected += 0.6 ** (3 - s) / 4 * (error[:3].sum() + error[3:7].sum() + 0.5 * error[7:].sum())
    mean = camera_loss(jnp.asarray(predicted), jnp.asarray(target), jnp.asarray(valid), **WEIGHTS)
    assert float(mean.value()) == pytest.approx(expected / 3, rel=1e-5)


def test_depth_losses_are_the_formulas() -> None:
    generator = np.random.default_rng(1)
    depth, target = generator.uniform(1, 2, (2, 1, 2, 4, 5))
    confidence = generator.uniform(1, 3, (1, 2, 4, 5))
    valid = generator.uniform(size=(1, 2, 4, 5)) < 0.7
    error = gradient = log = 0.0
    difference = depth - target
    for index in zip(*np.nonzero(valid), strict=True):
        *frame, y, x = index
        error += confidence[index] * abs(difference[index])
        log += np.log(confidence[index])
        for below in ((*frame, y + 1, x), (*frame, y, x + 1)):
            if below[2] < 4 and below[3] < 5 and valid[below]:
                gradient += confidence[index] * abs(difference[below] - difference[index])
    found = depth_losses(*map(jnp.asarray, (depth, confidence, target, valid)), alpha=0.2)
    count = valid.sum()
    assert float(found["depth_error"].value()) == pytest.approx(error / count, rel=1e-5)
    assert float(found["depth_gradient"].value()) == pytest.approx(gradient / count, rel=1e-5)
    assert float(found["depth_confidence"].value()) == pytest.approx(-0.2 * log / count, rel=1e-5)


def test_length_of_a_clip_does_not_change_its_weight() -> None:
    generator = np.random.default_rng(2)
    predicted, target = jnp.asarray(generator.normal(size=(1, 3, 2, 9))), jnp.asarray(generator.normal(size=(1, 3, 9)))
    once = camera_loss(predicted, target, jnp.ones((1, 3), bool), **WEIGHTS)
    twice = camera_loss(
        jnp.tile(predicted, (1, 2, 1, 1)), jnp.tile(target, (1, 2, 1)), jnp.ones((1, 6), bool), **WEIGHTS
    )
    assert float(once.value()) == pytest.approx(float(twice.value()), rel=1e-6)


def test_nothing_valid_gives_zero_with_a_finite_gradient() -> None:
    shape = (1, 2, 4, 5)

    def loss(depth: jax.Array, confidence: jax.Array, poses: jax.Array) -> jax.Array:
        terms = depth_losses(depth, confidence, jnp.zeros(shape), jnp.zeros(shape, bool), alpha=0.2)
        camera = camera_loss(poses, jnp.zeros((1, 2, 9)), jnp.zeros((1, 2), bool), **WEIGHTS)
        return camera.value() + sum(term.value() for term in terms.values())

    value, gradients = jax.jit(jax.value_and_grad(loss, (0, 1, 2)))(
        jnp.ones(shape), jnp.ones(shape), jnp.ones((1, 2, 4, 9))
    )
    assert float(value) == 0.0 and all(not np.asarray(gradient).any() for gradient in gradients)


def _paper_terms(depth, confidence, poses, target, wanted, pixels, frames) -> dict[str, Mean]:
    terms = losses.depth_losses(depth, confidence, target, pixels, alpha=0.2)
    return {**terms, "camera": losses.camera_loss(poses, wanted, frames, **WEIGHTS)}


def _vggt_terms(depth, confidence, poses, target, wanted, pixels, frames) -> dict[str, Mean]:
    terms = vggt.depth_losses(depth, confidence, target, pixels, alpha=0.2)
    return {**terms, **vggt.camera_losses(poses, wanted, frames, pixels, gamma=0.6)}


def _distilled_terms(depth, confidence, poses, target, wanted, pixels, frames) -> dict[str, Mean]:
    terms = distilled_depth_losses(depth, confidence, target, pixels, 2.0 + target, alpha=0.2)
    return {**terms, "camera": losses.camera_loss(poses, wanted, frames, **WEIGHTS)}


@pytest.mark.parametrize("terms", [_paper_terms, _vggt_terms, _distilled_terms])
def test_masked_pixels_frames_and_clips_have_no_gradient(terms: Callable[..., dict[str, Mean]]) -> None:
    generator = np.random.default_rng(4)
    # VGGT's losses count clips from a hundred pixels in the first frame on, and drop the largest of a thousand errors.
    shape = (3, 3, 20, 25)
    depth, target, confidence = generator.uniform(1, 2, (3, *shape))
    poses, wanted = generator.normal(size=(3, 3, 2, 9)), generator.normal(size=(3, 3, 9))
    pixels, frames = generator.uniform(size=shape) < 0.7, np.ones((3, 3), bool)
    frames[0, 2], frames[1] = False, False  # a frame of one clip, all of another
    pixels &= frames[..., None, None]

    @jax.jit
    def gradients(*predicted: jax.Array) -> tuple[jax.Array, ...]:
        def loss(*predicted: jax.Array) -> jax.Array:
            return sum(term.value() for term in terms(*predicted, target, wanted, pixels, frames).values())

        return jax.grad(loss, (0, 1, 2))(*predicted)

    of_depth, of_confidence, of_poses = map(np.asarray, gradients(depth, confidence, poses))
    for gradient in (of_depth, of_confidence):
        assert not gradient[~pixels].any() and gradient[pixels].any()
    assert not of_poses[~frames].any() and of_poses[frames].all((-2, -1)).all()
    # What is masked may be anything.
    found = gradients(
        np.where(pixels, depth, np.inf),
        np.where(pixels, confidence, 0.0),
        np.where(frames[..., None, None], poses, np.inf),
    )
    for changed, kept in zip(found, (of_depth, of_confidence, of_poses), strict=True):
        np.testing.assert_array_equal(changed, kept)


def test_invalid_pixels_have_no_influence() -> None:
    generator = np.random.default_rng(3)
    depth, target = generator.uniform(1, 2, (2, 1, 2, 4, 5))
    confidence = generator.uniform(1, 3, (1, 2, 4, 5))
    valid = generator.uniform(size=(1, 2, 4, 5)) < 0.7
    other = np.where(valid, depth, 1e6)
    found = [depth_losses(*map(jnp.asarray, (d, confidence, target, valid)), alpha=0.2) for d in (depth, other)]
    jax.tree.map(np.testing.assert_array_equal, *found)
