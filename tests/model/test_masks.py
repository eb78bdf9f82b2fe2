"""What lies under a mask has no influence, wherever tokens meet, and masked patches are no keys."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.model.masks import seen_patches, zero_where_masked

LENGTHS, HEIGHT, WIDTH = (7, 3), 28, 42
FRAMES = max(LENGTHS)
REAL = np.arange(FRAMES) < np.array(LENGTHS)[:, None]
OUTPUTS = ("depth", "depth_confidence", "camera_tokens", "register_tokens", "pose_encodings")


@functools.lru_cache
def applied(model: LogVGGT):
    compiled = jax.jit(lambda variables, images, masks: model.apply(variables, images, REAL, masks=masks))
    return lambda *given: jax.device_get(compiled(*given))


@functools.lru_cache
def started(model: LogVGGT):
    return jax.jit(model.start)


def video(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((len(LENGTHS), FRAMES, HEIGHT, WIDTH, 3), dtype=np.float32)


@pytest.fixture(scope="module")
def model(small_config: ModelConfig) -> LogVGGT:
    return LogVGGT(small_config)


@pytest.fixture(scope="module")
def masks() -> np.ndarray:
    """A whole patch in every frame, and part of another, which moves; one frame is masked whole."""
    masks = np.ones(video().shape[:-1], bool)
    masks[:, :, :14, :14] = False
    for frame in range(FRAMES):
        masks[:, frame, 18:24, 20 + frame : 24 + frame] = False
    masks[:, 1] = False
    return masks


def test_masked_content_changes_nothing_at_all(model, small_variables, masks):
    """Bit for bit, in whatever the model gives: three windows, their caches, GCCR, camera head and depth head."""
    other = np.where(masks[..., None], video(), video(1))
    assert (other != video()).any()
    found, again = (applied(model)(small_variables, images, masks) for images in (video(), other))
    for name in OUTPUTS:
        np.testing.assert_array_equal(getattr(found, name)[REAL], getattr(again, name)[REAL], err_msg=name)
        assert np.isfinite(getattr(found, name)[REAL]).all(), name
    without = applied(model)(small_variables, other, np.ones_like(masks))
    assert np.abs(without.camera_tokens - found.camera_tokens)[REAL].max() > 1e-3, "the mask is used at all"
    for name in ("depth", "depth_confidence"):
        np.testing.assert_array_equal(getattr(found, name)[REAL] > 0, masks[REAL], err_msg=name)


def test_nothing_attends_to_a_masked_patch(model, small_variables, masks, monkeypatch):
    """Even if its pixels were let through, they would reach no other patch, frame or special token."""
    monkeypatch.setattr("logvggt_jax.model.windows.without_masked", lambda pixels, masks: pixels)
    windows, masks = model.windows, np.repeat(np.repeat(seen_patches(masks, 14).reshape(2, -1, 2, 3), 14, 2), 14, 3)

    @jax.jit
    def second_window(images):
        first = windows.start(small_variables, images[:, :2], None, masks[:, :2])
        tokens = windows.encode(small_variables, images[:, :4], masks[:, :4])
        window = windows.attend(small_variables, first, tokens, None, masks[:, :4])
        state = first.replace(key_tokens=window.key[:, :, 2:], masks=masks[:, 2:4], step=first.step + 1)
        tokens = windows.encode(small_variables, images[:, 2:6], masks[:, 2:6])
        return windows.attend(small_variables, state, tokens, None, masks[:, 2:6])

    other = np.where(masks[..., None], video(), video(1))
    found, again = jax.device_get((second_window(video()), second_window(other)))
    np.testing.assert_array_equal(found.special, again.special)
    moved = (found.key != again.key).any((1, -1))[:, :, 5:]
    np.testing.assert_array_equal(moved, ~np.asarray(seen_patches(masks[:, 2:6], 14)))


def test_a_stream_with_masks_equals_the_batch_and_compiles_once(model, small_variables, masks):
    expected = applied(model)(small_variables, video(), masks)
    images, all_masks = (np.concatenate([x[:1], x[:1, -1:]], axis=1) for x in (video(), masks))
    step = jax.jit(model.step, donate_argnums=1)
    state, outs = started(model)(small_variables, images[:, :2], None, all_masks[:, :2]), []
    for first in (2, 4, 6):
        part = slice(first, first + 2)
        real = np.arange(first, first + 2)[None] < FRAMES
        state, out = step(small_variables, state, images[:, part], real, all_masks[:, part])
        outs.append(out)
    assert step._cache_size() == 1
    for name in ("depth", "depth_confidence", "camera_tokens"):
        found = np.concatenate([getattr(out, name) for out in outs], axis=1)
        np.testing.assert_allclose(found, getattr(expected, name)[:1, :6], rtol=2e-5, atol=2e-5, err_msg=name)


def test_masks_that_keep_all_change_nothing(model, small_variables, masks):
    windows, everything = model.windows, np.ones_like(masks)
    state = started(model)(small_variables, video()[:, :2], None, everything[:, :2])
    lengths = np.array([4, 3])
    with_masks, without = (
        jax.jit(lambda images, state, masks: windows.attend(small_variables, state, images, lengths, masks))(
            np.asarray(np.random.default_rng(0).standard_normal((2, 4, 6, 32)), np.float32), chosen, mask
        )
        for chosen, mask in ((state, everything[:, :4]), (state.replace(masks=None), None))
    )
    real = np.arange(4) < lengths[:, None]
    found, expected = (np.asarray(each.special)[real] for each in (with_masks, without))
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5)


def test_a_patch_is_seen_unless_more_than_half_of_it_is_masked():
    masks = np.ones((28, 42), bool)
    masks[:7, :14] = False
    masks[14:21, 28:] = False
    masks[21, 28] = False
    np.testing.assert_array_equal(seen_patches(masks, 14), [True, True, True, True, True, False])


def test_points_are_masked_as_depth_is():
    masks, points = np.array([[[[True, False]]]]), np.ones((1, 1, 1, 2, 3), np.float32)
    np.testing.assert_array_equal(jax.jit(zero_where_masked)(points, masks)[0, 0, 0], [[1, 1, 1], [0, 0, 0]])


def test_wrong_masks_are_named(model, small_variables, masks):
    images = video()
    for wrong, message in ((masks[:, :3], r"masks must be bool \[2, 7, 28, 42\]"), (masks.astype(np.uint8), "uint8")):
        with pytest.raises(ValueError, match=message):
            jax.eval_shape(lambda v, i, m: model.apply(v, i, masks=m), small_variables, images, wrong)
    state = jax.eval_shape(model.start, small_variables, images[:, :2])
    with pytest.raises(ValueError, match="masks for all frames or for none"):
        jax.eval_shape(model.step, small_variables, state, images[:, :2], None, masks[:, :2])
