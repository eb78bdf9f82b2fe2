"""Streams of constant size and cost, long refinements at the end, and what a stream tells while it runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, Predictions, RefinementConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.gccr import RegisterKeys
from logvggt_jax.streaming import (
    FrameResult,
    StreamSession,
    WindowSettings,
    load_stream,
    pose_stream,
    save_stream,
    token_store,
)
from logvggt_jax.streaming import windows as windows_module

COUNT = 13
CONSTANT = {"period": 2, "context": 3, "max_registers": 16}


def with_refinement(config: ModelConfig, **settings: int) -> LogVGGT:
    return LogVGGT(dataclasses.replace(config, refinement=RefinementConfig(num_heads=2, **settings)))


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return np.random.default_rng(2).integers(0, 256, (90, 28, 42, 3), np.uint8)


@pytest.fixture(scope="module")
def whole(small_config: ModelConfig, small_variables: dict, frames: np.ndarray) -> Predictions:
    """`model.apply` on the first frames; of other modes of refinement the poses alone are other ones."""
    return jax.device_get(jax.jit(with_refinement(small_config).apply)(small_variables, frames[None, :COUNT]))


def stream(session: StreamSession, frames: np.ndarray) -> list[FrameResult]:
    return [result for frame in frames for result in session.push(frame)] + session.close()


def test_registers_grow_where_camera_tokens_are_forgotten() -> None:
    """Without `max_registers` GCCR reads those of every frame, long after the camera tokens are gone."""

    def tokens(frame: int) -> jax.Array:
        return jnp.full((1, 1, 4, 2), frame, jnp.float32)

    store = token_store.TokenStore(first_capacity=4, reach=3)
    for frame in range(40):
        store.append(tokens(frame)[:, :, 0], RegisterKeys(tokens(frame), -tokens(frame)), 1)
    stored = store.arrays()
    again = token_store.TokenStore(first_capacity=4, reach=3)
    again.restore(stored)
    for each in (store, again):
        registers, seen = each.registers_at(40)
        assert registers is not None and int(seen[0]) == 40 and each.capacity < 10
        np.testing.assert_array_equal(registers.key[0, :40, 0, 0], np.arange(40))
        np.testing.assert_array_equal(each.camera[0, : each.position(40), 0][-3:], [37, 38, 39])
    assert again.registers.key.shape == store.registers.key.shape


def test_a_stream_that_forgets_gives_the_numbers_of_the_whole_sequence_at_constant_size(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    model = with_refinement(small_config, **CONSTANT)
    session = StreamSession(model, small_variables, first_capacity=1)
    assert session._poses._store._reach is not None
    programs = (windows_module._step, pose_stream._fire, token_store._write, token_store._place, token_store._slide)

    def state() -> tuple[list[int], int]:
        arrays = jax.tree.leaves((session._state, session._poses._store.__dict__))
        return [p._cache_size() for p in programs], sum(x.nbytes for x in arrays if isinstance(x, jax.Array))

    results: list[FrameResult] = []
    for index, frame in enumerate(frames):
        results += session.push(frame)
        if index == 70:
            before = state()
    assert session._poses._store._forgotten > 0 and state() == before
    results += session.close()
    expected = jax.jit(model.apply)(small_variables, frames[None])
    np.testing.assert_allclose([r.depth for r in results], expected.depth[0], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(session.cameras().pose_encoding, expected.pose_encoding[0], rtol=1e-3, atol=1e-4)
    with pytest.raises(ValueError, match="forgotten"):
        session.cameras_with(RefinementConfig(num_heads=2))


@pytest.mark.parametrize(
    "settings", [{"context": 4}, {}, {"max_registers": 24}], ids=["context", "no context", "few registers"]
)
def test_a_long_sequence_is_refined_block_by_block_with_a_limited_context(
    small_config: ModelConfig,
    small_variables: dict,
    frames: np.ndarray,
    whole: Predictions,
    settings: dict,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pose_stream, "LONG_SEQUENCE", 8)
    monkeypatch.setattr(pose_stream, "LONG_CONTEXT", 4)
    monkeypatch.setattr(pose_stream, "_BLOCK", 5)
    told: list[tuple[int, int]] = []
    session = StreamSession(with_refinement(small_config, **settings), small_variables, first_capacity=16)
    session.push(frames[:COUNT])
    if "context" in settings:
        session.close(lambda done, count: told.append((done, count)))
    else:
        with pytest.warns(UserWarning, match=r"13 frames are more than .* 4 frames .* refinement\.context"):
            session.close(lambda done, count: told.append((done, count)))
    assert told == [(4, 13), (8, 13), (12, 13), (13, 13)]
    refinement = with_refinement(small_config, **{**settings, "context": 4}).refinement
    expected = jax.device_get(
        jax.jit(refinement.refine_sequence)(
            small_variables, whole.camera_tokens, whole.register_tokens, np.ones((1, COUNT), bool)
        )
    )
    np.testing.assert_allclose(session.cameras().pose_encoding, expected[0, :, -1], rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("settings", [CONSTANT, {}], ids=["constant", "at the end"])
def test_newest_frames_are_those_of_a_stream_that_ends_there_and_nothing_is_disturbed(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, settings: dict
) -> None:
    model = with_refinement(small_config, **settings)
    session = StreamSession(model, small_variables, first_capacity=16)
    results: list[FrameResult] = []
    for index, frame in enumerate(frames[:COUNT]):
        results += session.push(frame)
        if index not in (0, 2, 6, 9):
            continue
        found = session.provisional()
        ended = StreamSession(model, small_variables, first_capacity=16)
        expected = stream(ended, frames[: index + 1])[len(results) :]
        assert [each.index for each in found] == [each.index for each in expected]
        for each, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(each.depth, other.depth)
            np.testing.assert_array_equal(each.pose_encoding, other.pose_encoding)
        assert not any(each.pose_is_final for each in found[-2:])
    results += session.close()
    straight = StreamSession(model, small_variables, first_capacity=16)
    for each, other in zip(results, stream(straight, frames[:COUNT]), strict=True):
        np.testing.assert_array_equal(each.depth, other.depth)
    np.testing.assert_array_equal(session.cameras().pose_encoding, straight.cameras().pose_encoding)


def test_a_stream_tells_how_well_its_windows_agree(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, whole: Predictions
) -> None:
    model = with_refinement(small_config)
    session = StreamSession(model, small_variables, first_capacity=16)
    results = stream(session, frames[:COUNT])
    assert all(result.latency is not None and result.latency >= 0 for result in results)
    signals = session.signals()
    # By hand: the windows one by one, and the refinement on their tokens.
    step = jax.jit(model.step)
    state = jax.jit(model.start)(small_variables, frames[None, :2])
    copies: dict[int, list[np.ndarray]] = {}
    for first in range(0, 10, 2):
        state, out = step(small_variables, state, frames[None, first + 2 : first + 4])
        for offset in range(2):
            copies.setdefault(first + offset, []).append(np.asarray(out.camera_tokens[0, offset]))
            copies.setdefault(first + offset + 2, []).append(np.asarray(state.special_tokens[0, offset, 0]))
    for index in range(2, 10):
        old, new = copies[index]
        change = np.linalg.norm(new - old) / np.linalg.norm(old)
        assert results[index].overlap_change == pytest.approx(change, rel=1e-3)
    assert [result.overlap_change is None for result in results] == [True] * 2 + [False] * 10 + [True]
    np.testing.assert_array_equal(np.isnan(signals.overlap_change), [r.overlap_change is None for r in results])
    refined = model.refinement.refine_tokens(
        small_variables, whole.camera_tokens, whole.register_tokens, np.ones((1, COUNT), bool)
    )
    correction = np.linalg.norm(refined - whole.camera_tokens, axis=-1) / np.linalg.norm(whole.camera_tokens, axis=-1)
    np.testing.assert_allclose(signals.correction, correction[0], rtol=1e-3)


def test_sessions_of_one_model_take_turns_and_compile_once(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    model = with_refinement(small_config, **CONSTANT)
    alone = StreamSession(model, small_variables, first_capacity=16)
    expected = [result.depth for result in stream(alone, frames[:9])]
    compiled = windows_module._step._cache_size(), pose_stream._fire._cache_size()
    first, second = (StreamSession(model, small_variables, first_capacity=16) for _ in range(2))
    depth: list[np.ndarray] = []
    for ours, others in zip(frames[:9], frames[20:29], strict=True):
        depth += [result.depth for result in first.push(ours)]
        second.push(others)
    depth += [result.depth for result in first.close()]
    np.testing.assert_array_equal(depth, expected)
    np.testing.assert_array_equal(first.cameras().pose_encoding, alone.cameras().pose_encoding)
    assert (windows_module._step._cache_size(), pose_stream._fire._cache_size()) == compiled


def test_a_stream_goes_on_from_a_file_of_the_same_model_alone(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, tmp_path: Path
) -> None:
    model, file = with_refinement(small_config, **CONSTANT), tmp_path / "stream.safetensors"

    settings = WindowSettings(first_capacity=16)
    straight, begun = (StreamSession(model, small_variables, settings) for _ in range(2))
    expected = stream(straight, frames[:COUNT])
    results = begun.push(frames[:7]) + save_stream(file, begun, model, small_variables, settings=settings)
    session = load_stream(file, model, small_variables, settings=settings)
    assert isinstance(session, StreamSession)
    results += session.push(frames[7:COUNT]) + session.close()
    for each, other in zip(results, expected, strict=True):
        np.testing.assert_array_equal(each.depth, other.depth)
    np.testing.assert_array_equal(session.cameras().pose_encoding, straight.cameras().pose_encoding)
    np.testing.assert_array_equal(session.signals().overlap_change, straight.signals().overlap_change)

    other = jax.tree.map(lambda x: x + 1, small_variables)
    with pytest.raises(InputError, match=r"differs in parameters; give those that it was saved with"):
        load_stream(file, model, other, settings=settings)
    with pytest.raises(InputError, match=r"differs in model"):
        load_stream(file, with_refinement(small_config), small_variables, settings=settings)
    with pytest.raises(InputError, match=r"differs in method, settings"):
        load_stream(file, model, small_variables, method="causal")
    damaged = bytearray(file.read_bytes())
    damaged[-1] ^= 1
    file.write_bytes(damaged)
    with pytest.raises(InputError, match=r"stream\.safetensors: damaged"):
        load_stream(file, model, small_variables, settings=settings)
    with pytest.raises(InputError, match="No such file"):
        load_stream(tmp_path / "nothing", model, small_variables)


def test_a_closed_stream_does_not_take_the_place_of_an_earlier_state(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, tmp_path: Path
) -> None:
    model, file = with_refinement(small_config, **CONSTANT), tmp_path / "stream.safetensors"
    session = StreamSession(model, small_variables)
    session.push(frames[:5])
    save_stream(file, session, model, small_variables)
    session.close()
    with pytest.raises(ValueError, match="this stream is closed: save a stream before it is closed"):
        save_stream(file, session, model, small_variables)
    assert load_stream(file, model, small_variables).num_frames == 2
    with pytest.raises(InputError, match="unknown method 'window'; known are windows, "):
        load_stream(file, model, small_variables, method="window")
