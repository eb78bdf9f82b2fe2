"""GCCR: what it sees, when it runs, and that streams and whole sequences agree in every mode."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, RefinementConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.kept_registers import is_kept
from logvggt_jax.model.refinement import num_triggers

WIDTH = 64
FRAMES = 11


def with_refinement(config: ModelConfig, **options) -> LogVGGT:
    settings = dataclasses.replace(config.refinement, **options)
    return LogVGGT(dataclasses.replace(config, refinement=settings))


def tokens(num_frames: int = FRAMES, batch: int = 1, seed: int = 0):
    generator = np.random.default_rng(seed)
    camera = generator.standard_normal((batch, num_frames, WIDTH)).astype(np.float32)
    register = generator.standard_normal((batch, num_frames, 4, WIDTH)).astype(np.float32)
    return camera, register


def compiled(function):
    """As one program, whose results are numpy's: each slice of another array would be a program."""
    jitted = jax.jit(function)
    return lambda *given: jax.device_get(jitted(*given))


@functools.lru_cache
def sequence(model: LogVGGT):
    return compiled(model.refinement.refine_sequence)


@functools.lru_cache
def refine(model: LogVGGT):
    return compiled(model.refine)


@functools.lru_cache
def parts(config: ModelConfig):
    """GCCR and the camera head by themselves: no mode is in them, so that all modes share what they compile."""
    refinement = LogVGGT(config).refinement
    return compiled(refinement.refine_tokens), compiled(refinement.decode_cameras)


def full(num_frames: int = FRAMES, batch: int = 1) -> np.ndarray:
    return np.ones((batch, num_frames), bool)


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=2e-5, atol=2e-5)


def test_zero_output_projection_is_the_identity(small_config, small_variables):
    params = dict(small_variables["params"])
    params["gccr"] = dict(params["gccr"], output=jax.tree.map(np.zeros_like, params["gccr"]["output"]))
    camera, register = tokens()
    refined = parts(small_config)[0]({"params": params}, camera, register, full())
    np.testing.assert_array_equal(refined, camera)


def test_fresh_parameters_leave_camera_tokens_alone(small_config, small_variables):
    model = LogVGGT(small_config)
    images = np.zeros((1, 1, 28, 42, 3), np.float32)
    fresh = jax.jit(lambda: model.init(jax.random.key(3), images)["params"]["gccr"])()
    camera, register = tokens()
    variables = {"params": small_variables["params"] | {"gccr": fresh}}
    np.testing.assert_array_equal(parts(small_config)[0](variables, camera, register, full()), camera)


def test_disabled_is_the_camera_head_alone(small_config, small_variables):
    model = with_refinement(small_config, enabled=False)
    camera, register = tokens()
    poses = sequence(model)(small_variables, camera, register, full())
    close(poses, parts(small_config)[1](small_variables, camera, full()))
    with pytest.raises(AssertionError):
        close(poses, sequence(LogVGGT(small_config))(small_variables, camera, register, full()))


def test_one_register_token_moves_another_frames_pose(small_config, small_variables):
    run = refine(with_refinement(small_config))
    camera, register = tokens()
    other = register.copy()
    other[:, 7, 2] = tokens(seed=2)[1][:, 7, 2]
    before = run(small_variables, camera, register, full(), full())
    after = run(small_variables, camera, other, full(), full())
    assert np.abs(after - before)[0, 0].max() > 1e-5


def test_permuting_registers_changes_nothing(small_config, small_variables):
    run = refine(with_refinement(small_config))
    camera, register = tokens()
    order = np.random.default_rng(1).permutation(4 * FRAMES)
    permuted = register.reshape(1, -1, WIDTH)[:, order].reshape(register.shape)
    close(
        run(small_variables, camera, permuted, full(), full()),
        run(small_variables, camera, register, full(), full()),
    )


def test_padding_changes_nothing(small_config, small_variables):
    run = refine(with_refinement(small_config))
    camera, register = tokens()
    mask = np.arange(FRAMES)[None] < 8
    rubbish_camera = np.where(mask[..., None], camera, np.float32(9))
    rubbish_register = np.where(mask[..., None, None], register, np.float32(9))
    a = run(small_variables, camera, register, mask, mask)
    b = run(small_variables, rubbish_camera, rubbish_register, mask, mask)
    np.testing.assert_array_equal(a[:, :8], b[:, :8])


@pytest.mark.parametrize("period", [FRAMES, FRAMES + 5])
def test_a_period_of_all_frames_is_the_full_refinement(small_config, small_variables, period):
    camera, register = tokens()
    periodic = sequence(with_refinement(small_config, period=period))(small_variables, camera, register, full())
    once = sequence(with_refinement(small_config))(small_variables, camera, register, full())
    close(periodic, once)


def refined_frames(trigger: int, num_frames: int, period: int | None) -> tuple[int, int]:
    """Frames [start, stop) that a trigger (from 0) refines; they see the registers of frames [0, stop)."""
    if period is None:
        return 0, num_frames
    return trigger * period, min((trigger + 1) * period, num_frames)


@pytest.mark.parametrize("period", [2, 3, 4])
def test_periodic_poses_know_the_past_only_and_stay(small_config, small_variables, period):
    run = sequence(with_refinement(small_config, period=period))
    camera, register = tokens()
    for trigger in range(num_triggers(FRAMES, period) - 1):
        _, stop = refined_frames(trigger, FRAMES, period)
        other_camera, other_register = camera.copy(), register.copy()
        other_camera[:, stop:], other_register[:, stop:] = (x[:, stop:] for x in tokens(seed=2))
        before = run(small_variables, camera, register, full())
        after = run(small_variables, other_camera, other_register, full())
        np.testing.assert_array_equal(before[:, :stop], after[:, :stop])
        assert np.abs(after - before)[:, stop:].max() > 1e-5


def by_hand(config: ModelConfig, settings: RefinementConfig, variables, camera, register) -> np.ndarray:
    """Design of the modes, trigger by trigger and group by group, without masks or fixed shapes."""
    refine_tokens, decode_cameras = parts(config)
    group = config.windows.stride
    num_frames = camera.shape[1]
    refined = camera.copy()
    poses = []
    for trigger in range(num_triggers(num_frames, settings.period)):
        start, stop = refined_frames(trigger, num_frames, settings.period)
        past = register[:, :stop]
        if settings.max_registers is not None:
            past = past[:, is_kept(np.arange(stop), np.array(stop), settings.max_registers // 4)]
        refined[:, start:stop] = refine_tokens(variables, camera[:, start:stop], past, full(past.shape[1]))
        if settings.context is None:
            poses.append(decode_cameras(variables, refined[:, :stop], full(stop))[:, start:])
            continue
        for first in range(start, stop, group):
            last = min(first + group, stop)
            seen = sorted({0, *range(max(0, last - settings.context), last)})
            decoded = decode_cameras(variables, refined[:, seen], full(len(seen)))
            poses.append(decoded[:, [seen.index(f) for f in range(first, last)]])
    return np.concatenate(poses, axis=1)


@pytest.mark.parametrize(
    ("period", "context", "max_registers"),
    [
        (None, None, None),
        (3, None, None),
        (2, None, None),
        (None, 4, None),
        (4, 3, None),
        (2, 2, None),
        (5, 20, None),
        (None, None, 16),
        (2, 2, 12),
    ],
)
def test_modes_equal_their_definition(small_config, small_variables, period, context, max_registers):
    model = with_refinement(small_config, period=period, context=context, max_registers=max_registers)
    camera, register = tokens()
    expected = by_hand(small_config, model.config.refinement, small_variables, camera, register)
    close(sequence(model)(small_variables, camera, register, full()), expected)


@pytest.mark.parametrize(
    ("period", "context", "max_registers"), [(None, 4, None), (3, None, None), (3, 4, None), (2, 2, 16)]
)
def test_unequal_lengths_equal_items_one_by_one(small_config, small_variables, period, context, max_registers):
    model = with_refinement(small_config, period=period, context=context, max_registers=max_registers)
    lengths = (FRAMES, 6, 1)
    camera, register = tokens(batch=len(lengths))
    mask = np.arange(FRAMES)[None] < np.array(lengths)[:, None]
    batch = sequence(model)(small_variables, camera, register, mask)
    for item, length in enumerate(lengths):
        one = slice(item, item + 1)
        alone = small_variables, camera[one, :length], register[one, :length]
        close(batch[one, :length], by_hand(small_config, model.config.refinement, *alone))


def test_memory_grows_at_most_linearly(small_config, small_variables):
    model = LogVGGT(small_config)

    def temporaries(num_frames):
        camera = jax.ShapeDtypeStruct((1, num_frames, WIDTH), jnp.float32)
        register = jax.ShapeDtypeStruct((1, num_frames, 4, WIDTH), jnp.float32)
        mask = jax.ShapeDtypeStruct((1, num_frames), bool)
        compiled = jax.jit(model.refine).lower(small_variables, camera, register, mask, mask).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert temporaries(4000) < 2.2 * temporaries(2000)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({0: np.zeros((1, FRAMES, 32), np.float32)}, r"camera_tokens must be floating point \[any, any, 64\].*32"),
        ({0: np.zeros((1, FRAMES, WIDTH), np.int32)}, r"camera_tokens must be floating point .*got int32"),
        ({1: np.zeros((1, FRAMES, WIDTH), np.float32)}, r"register_tokens must be floating point \[1, any, 4, 64\]"),
        ({1: np.zeros((2, FRAMES, 4, WIDTH), np.float32)}, r"register_tokens must be .*got float32 \[2, 11, 4, 64\]"),
        ({2: full(FRAMES - 1)}, r"camera_mask must be bool \[1, 11\], got bool \[1, 10\]"),
        ({3: full().astype(np.float32)}, r"register_mask must be bool \[1, 11\], got float32"),
    ],
)
def test_wrong_input_is_named(small_config, small_variables, changes, message):
    arguments = dict(enumerate((*tokens(), full(), full()))) | changes
    with pytest.raises(ValueError, match=message) as error:
        LogVGGT(small_config).refine(small_variables, *arguments.values())
    assert "\n" not in str(error.value)


def test_context_smaller_than_the_stride_is_refused(small_config):
    with pytest.raises(ValueError, match="context=1 must be at least the window stride 2"):
        with_refinement(small_config, context=1)


def test_registers_of_less_than_two_frames_are_refused(small_config):
    with pytest.raises(InputError, match="max_registers=7 must be at least 8"):
        with_refinement(small_config, max_registers=7)
