"""Windows: streaming equals batch, unequal lengths, who influences whom, and what the state weighs."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, WindowConfig
from logvggt_jax.model.windows import num_windows

HEIGHT, WIDTH = 28, 42
MAX_FRAMES = 13
WINDOWS = [(4, 2), (4, 1), (5, 3)]


def with_windows(config: ModelConfig, size: int, stride: int, **options) -> LogVGGT:
    return LogVGGT(dataclasses.replace(config, windows=WindowConfig(size=size, stride=stride, **options)))


def video(num_frames: int, batch: int = 1, seed: int = 0) -> np.ndarray:
    shape = (batch, num_frames, HEIGHT, WIDTH, 3)
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def padded_groups(images: np.ndarray, model: LogVGGT):
    """The frames of a stream: the first K − s, then groups of s, with their masks; the tail holds rubbish."""
    size, stride = model.config.windows.size, model.config.windows.stride
    num_frames, overlap = images.shape[1], size - stride
    total = num_windows(num_frames, size, stride) * stride + overlap
    rubbish = video(total, images.shape[0], seed=99)
    rubbish[:, :num_frames] = images
    mask = np.broadcast_to(np.arange(total) < num_frames, (images.shape[0], total))
    bounds = [0, *range(overlap, total + 1, stride)]
    return [(rubbish[:, a:b], mask[:, a:b]) for a, b in itertools.pairwise(bounds)]


@functools.lru_cache
def jitted(model: LogVGGT):
    """Compiled once for all lengths: start, step (its state donated), finish."""
    return jax.jit(model.start), jax.jit(model.step, donate_argnums=1), jax.jit(model.finish)


def stream(model: LogVGGT, variables, images: np.ndarray):
    """Window outputs of all frames [B, T, …] and the refined poses, through start / step / finish / refine."""
    start, step, finish = jitted(model)
    first, *groups = padded_groups(images, model)
    state = start(variables, *first)
    outs = []
    for frames, mask in groups:
        state, out = step(variables, state, frames, mask)
        outs.append(out)
    outs.append(finish(variables, state))
    joined = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *outs)
    num_frames = images.shape[1]
    np.testing.assert_array_equal(joined.frame_mask[0], np.arange(joined.frame_mask.shape[1]) < num_frames)
    # Padded to one length, so that all sequences share a compiled refinement.
    padding = [(0, 0), (0, max(0, MAX_FRAMES - joined.frame_mask.shape[1]))]
    camera, register, mask = (
        np.pad(x, padding + [(0, 0)] * (x.ndim - 2))
        for x in (joined.camera_tokens, joined.register_tokens, joined.frame_mask)
    )
    poses = np.asarray(refine(model)(variables, camera, register, mask, mask))
    return jax.tree.map(lambda x: x[:, :num_frames], joined), poses[:, :num_frames]


@functools.lru_cache
def refine(model: LogVGGT):
    return jax.jit(model.refine)


def close(actual, expected, tolerance=2e-5):
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("size", "stride"), [(2, 1), (4, 1), (4, 2), (4, 3), (7, 3)])
def test_window_arithmetic(size, stride):
    for num_frames in range(1, 40):
        windows = num_windows(num_frames, size, stride)
        starts = [i * stride for i in range(windows)]
        covered = {f for a in starts for f in range(a, a + size)}
        assert set(range(num_frames)) <= covered
        assert windows == 1 or starts[-1] + size - stride < num_frames, "the last window brings a new frame"


@pytest.fixture(scope="module")
def moderate_variables(small_variables):
    """The small network with a quarter of the depth head's outputs, whose exponentials are depth and confidence.

    As random numbers left them they reach 21, where one unit in the last place is 2e-6 of the exponential.
    """
    variables = jax.tree.map(lambda x: x, small_variables)
    last = variables["params"]["depth_head"]["output_2"]
    last.update({name: x / 4 for name, x in last.items()})
    return variables


@pytest.mark.parametrize(
    ("size", "stride"), [WINDOWS[0], *(pytest.param(*each, marks=pytest.mark.slow) for each in WINDOWS[1:])]
)
def test_streaming_equals_batch(small_config, moderate_variables, size, stride):
    """All lengths 1 … 13 in one padded batch, against each length as a stream of its own."""
    model = with_windows(small_config, size, stride)
    images = video(MAX_FRAMES, MAX_FRAMES)
    lengths = np.arange(1, MAX_FRAMES + 1)
    batch = jax.device_get(jax.jit(model.apply)(moderate_variables, images, np.arange(MAX_FRAMES) < lengths[:, None]))
    assert np.ptp(np.log(batch.depth[-1])) > 4, "depths differ, or their comparison says little"
    for item, length in enumerate(lengths):
        out, poses = stream(model, moderate_variables, images[item : item + 1, :length])
        for name in ("depth", "depth_confidence", "camera_tokens", "register_tokens"):
            close(getattr(out, name)[0], getattr(batch, name)[item, :length])
        close(poses[0], batch.pose_encodings[item, :length])


def test_unequal_lengths_equal_items_one_by_one(small_config, small_variables):
    model, lengths = with_windows(small_config, 4, 3), (7, 2)
    compiled = jax.jit(model.apply)

    def apply(*given):
        return jax.device_get(compiled(*given))

    images = video(max(lengths), len(lengths))
    mask = np.arange(max(lengths)) < np.array(lengths)[:, None]
    batch = apply(small_variables, images, mask)
    rubbish = np.where(mask[:, :, None, None, None], images, np.float32(7.0))
    assert_same_predictions(apply(small_variables, rubbish, mask), batch, lengths)
    for item, length in enumerate(lengths):
        if length == max(lengths):
            # Beside itself instead of a shorter sequence: one program less.
            whole = np.ones_like(mask)
            single = apply(small_variables, images[[item, item]], whole)
        else:
            single = apply(small_variables, images[item : item + 1, :length])
        for name in ("depth", "depth_confidence", "camera_tokens", "register_tokens", "pose_encodings"):
            close(getattr(batch, name)[item, :length], getattr(single, name)[0])


def assert_same_predictions(actual, expected, lengths):
    for item, length in enumerate(lengths):
        for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a[item, :length], b[item, :length])


@functools.lru_cache
def scan(model: LogVGGT):
    return jax.jit(model.windows.scan)


@functools.lru_cache
def attention_alone(model: LogVGGT):
    """A scan of which the compact tokens are read: the compiler leaves the dense heads out."""
    return jax.jit(lambda *given: dataclasses.replace(model.windows.scan(*given), depth=None, depth_confidence=None))


def changed_frames(model, variables, images, frame, name="camera_tokens", scan=attention_alone):
    """Which frames' outputs are not bit-identical once `frame` is another picture."""
    other = images.copy()
    other[:, frame] = video(1, seed=5)[:, 0]
    run = scan(model)
    before, after = (np.asarray(getattr(run(variables, x), name)) for x in (images, other))
    return {i for i in range(images.shape[1]) if not np.array_equal(before[:, i], after[:, i])}


def windows_with(frame):
    """The windows (K = 4, s = 2) of a video of 12 frames that hold `frame`; the last one's copy of it counts."""
    return [i for i in range(num_windows(12, 4, 2)) if 2 * i <= frame < 2 * i + 4]


@pytest.mark.parametrize("name", ["camera_tokens", "depth", "depth_confidence", "register_tokens"])
def test_frames_after_the_last_window_change_nothing(small_config, small_variables, name):
    model, images = with_windows(small_config, 4, 2), video(12)
    for frame in (5, 8, 11):
        changed = changed_frames(model, small_variables, images, frame, name, scan)
        first = windows_with(frame)[0]
        assert changed == {f for f in range(12) if windows_with(f)[-1] >= first}


def test_without_cross_window_attention_windows_know_nothing_of_each_other(small_config, small_variables):
    model, images = with_windows(small_config, 4, 2, cross_window=False), video(12)
    for frame in (0, 3, 6):
        changed = changed_frames(model, small_variables, images, frame)
        assert changed == {f for f in range(12) if windows_with(f)[-1] in windows_with(frame)}


def test_cache_of_outputs_reaches_every_later_window(small_config, small_variables):
    model, images = with_windows(small_config, 4, 2, cache="output"), video(24)
    assert changed_frames(model, small_variables, images, 0) == set(range(24))


def test_cache_of_inputs_reaches_as_many_windows_as_there_are_key_layers(small_config, small_variables):
    # Key layers that follow another global block: each hop climbs one of them.
    sizes = dataclasses.replace(small_config.aggregator, depth=5, key_layers=(1, 2, 3, 4))
    config = dataclasses.replace(small_config, aggregator=sizes)
    variables = {"params": dict(small_variables["params"])}
    aggregator = dict(variables["params"]["aggregator"])
    aggregator["frame_block_4"], aggregator["global_block_4"] = (
        jax.tree.map(lambda x: x * 1.1, aggregator[f"{kind}_block_0"]) for kind in ("frame", "global")
    )
    variables["params"]["aggregator"] = aggregator
    model, images = with_windows(config, 4, 2, cache="input"), video(24)
    # Frame 0 is in window 0 and reaches windows 1 … 4, the last of which keeps frames 8 and 9.
    assert changed_frames(model, variables, images, 0) == set(range(10))


def test_attention_mixes_patches_and_frames(small_config, small_variables):
    # The last window's frames, 8 … 11, all of which it hands out.
    model, images = with_windows(small_config, 4, 2), video(12)
    other = images.copy()
    other[:, 9, :14, :14] = 0.0
    run = scan(model)
    before, after = run(small_variables, images), run(small_variables, other)
    moved = np.abs(np.asarray(before.depth) - np.asarray(after.depth))[0]
    assert (moved[9, 14:, 28:] > 1e-6).mean() > 0.9, "other patches of the frame"
    for frame in (8, 10, 11):
        assert (moved[frame] > 1e-6).mean() > 0.9, "other frames of the window"


@pytest.mark.slow
def test_one_window_of_any_size_is_the_same(small_config, small_variables):
    """T <= K: cache, stride and K play no part, so plain VGGT over the T frames is all that happens."""
    for num_frames in (1, 3):
        images = video(num_frames)
        plain = with_windows(small_config, max(num_frames, 2), 1, cross_window=False)
        expected, found = (scan(each)(small_variables, images) for each in (plain, with_windows(small_config, 4, 2)))
        jax.tree.map(close, found, expected)


@pytest.mark.parametrize("cache", ["output", "input"])
def test_state_has_the_same_bytes_at_any_length(small_config, small_variables, cache):
    model = with_windows(small_config, 4, 2, cache=cache)
    step = jax.eval_shape(model.start, small_variables, video(2))
    after = jax.eval_shape(model.step, small_variables, step, video(2))[0]
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), step)


def test_scan_temporaries_do_not_grow_with_the_sequence(small_config, small_variables):
    model = with_windows(small_config, 4, 2)

    def temporaries(num_frames):
        images = jax.ShapeDtypeStruct((1, num_frames, HEIGHT, WIDTH, 3), jnp.uint8)
        compiled = jax.jit(model.windows.scan).lower(small_variables, images).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert temporaries(100) == temporaries(1000)


def test_donated_state_holds_no_buffer_twice(small_config, small_variables):
    model = with_windows(small_config, 4, 2)
    state = jax.jit(model.start)(small_variables, video(2))
    pointers = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(state)]
    assert len(set(pointers)) == len(pointers)
    new_state, _ = jax.jit(model.step, donate_argnums=1)(small_variables, state, video(2), np.ones((1, 2), bool))
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(new_state))


@pytest.mark.parametrize(
    ("images", "mask", "message"),
    [
        (np.zeros((1, 2, 28, 42)), None, "shape"),
        ([np.zeros((2, 28, 42, 3), np.uint8)], None, "images must be an array, got list"),
        (np.zeros((1, 2, 28, 40, 3), np.float32), None, "multiples of 14"),
        (np.zeros((1, 2, 28, 42, 3), np.int32), None, "dtype int32"),
        (np.zeros((1, 0, 28, 42, 3), np.float32), None, "T >= 1"),
        (np.zeros((1, 2, 28, 42, 3), np.float32), np.ones((1, 3), bool), "frame_mask"),
        (np.zeros((1, 2, 28, 42, 3), np.float32), np.ones((1, 2)), "frame_mask"),
        (np.zeros((1, 2, 28, 42, 3), np.float32), [[True, True]], "frame_mask must be an array, got list"),
    ],
)
def test_wrong_input_is_named(small_config, small_variables, images, mask, message):
    with pytest.raises(ValueError, match=message) as error:
        LogVGGT(small_config).apply(small_variables, images, mask)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (video(3), r"step takes 2 frames.*got 3"),
        (video(2)[..., :14, :], r"continues a stream of 1 x \(28, 42\) images.*got 1 x \(28, 14\)"),
        (video(2, batch=3), r"continues a stream of 1 x \(28, 42\) images.*got 3 x \(28, 42\)"),
    ],
)
def test_step_names_what_it_takes(small_config, small_variables, frames, message):
    model = LogVGGT(small_config)
    state = jax.eval_shape(model.start, small_variables, video(2))
    with pytest.raises(ValueError, match=message) as error:
        jax.eval_shape(model.step, small_variables, state, frames)
    assert "\n" not in str(error.value)


def test_a_traced_function_may_close_over_images_of_floating_point(small_config, small_variables):
    """Their values are looked at as they are outside; only what is traced itself has none."""
    model = LogVGGT(small_config)
    images = jnp.asarray(video(2), jnp.float32)
    start = jax.eval_shape(lambda variables: model.start(variables, images), small_variables)
    assert start.patch_tokens.shape[:2] == (1, 2)
    grey_levels = 2 + images
    with pytest.raises(ValueError, match=r"must be floating point in \[0, 1\], got values from"):
        jax.eval_shape(lambda variables: model.start(variables, grey_levels), small_variables)


@pytest.mark.parametrize("to_array", [np.asarray, jnp.asarray])
def test_one_pixel_that_is_no_number_is_found(small_config, small_variables, to_array):
    """Of so many values XLA gives a smallest and a largest one on a CPU as if that pixel were not there."""
    images = np.full((2, 4, 28, 42, 3), 0.5, np.float32)
    images[1, 3, 4, 5, 0] = np.nan
    with pytest.raises(
        ValueError, match=r"images must be floating point in \[0, 1\], got values from nan to nan; no pixel may"
    ):
        LogVGGT(small_config).apply(small_variables, to_array(images))


def test_before_the_first_window_no_frame_counts(small_config, small_variables):
    model = LogVGGT(small_config)
    start, step, finish = jitted(model)
    images = video(4)
    state = start(small_variables, images[:, :2])
    assert not finish(small_variables, state).frame_mask.any()
    state, _ = step(small_variables, state, images[:, 2:], np.ones((1, 2), bool))
    assert finish(small_variables, state).frame_mask.all()
