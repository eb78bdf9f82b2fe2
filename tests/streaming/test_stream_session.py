"""A stream gives the numbers of the whole sequence, in every mode, at constant state."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, Predictions, RefinementConfig, WindowConfig
from logvggt_jax.errors import InputError
from logvggt_jax.streaming import METHODS, ChunkPlan, LoopSettings, open_predictor, pose_stream
from logvggt_jax.streaming import windows as session_module
from logvggt_jax.streaming.loops import LoopCloser
from logvggt_jax.streaming.program import compiled_meanwhile
from logvggt_jax.streaming.results import Cameras
from logvggt_jax.streaming.windows import FrameResult, StreamSession, WindowSettings

HEIGHT, WIDTH = 28, 42
LENGTHS = np.tri(13, dtype=bool)  # frame masks of 1, 2 … 13 frames
COUNTS = [1, 4, 6, 10, 13]


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (13, HEIGHT, WIDTH, 3), np.uint8)


def with_modes(config: ModelConfig, *, size: int = 4, stride: int = 2, **refinement: object) -> LogVGGT:
    return LogVGGT(
        dataclasses.replace(
            config,
            windows=WindowConfig(size=size, stride=stride),
            refinement=RefinementConfig(num_heads=2, **refinement),  # type: ignore[arg-type]
        )
    )


def stream(session: StreamSession, frames: np.ndarray) -> list[FrameResult]:
    results = [result for frame in frames for result in session.push(frame)]
    return results + session.close()


@pytest.fixture(scope="module")
def whole(small_config: ModelConfig, small_variables: dict, frames: np.ndarray) -> Predictions:
    """`model.apply` on the first 1, 2 … 13 frames, as one batch."""
    images = np.repeat(frames[None], len(frames), axis=0)
    return jax.device_get(jax.jit(with_modes(small_config).apply)(small_variables, images, LENGTHS))


@functools.partial(jax.jit, static_argnums=0)
def refine(model: LogVGGT, *arguments: Any) -> jax.Array:
    return model.refinement.refine_sequence(*arguments)


def assert_equals_whole(
    model: LogVGGT, variables: dict, frames: np.ndarray, whole: Predictions, counts: list[int], **options: int
) -> None:
    """Streams of these of `COUNTS` frames give the depth in `whole` and the poses that the model's mode makes of its
    tokens."""
    assert counts and set(counts) <= set(COUNTS)
    rows = np.array(COUNTS) - 1
    tokens = whole.camera_tokens[rows], whole.register_tokens[rows]
    expected = np.asarray(refine(model, variables, *tokens, LENGTHS[rows]))
    for count, encodings in zip(COUNTS, expected, strict=True):
        if count not in counts:
            continue
        session = StreamSession(model, variables, **options)
        results = stream(session, frames[:count])
        assert [result.index for result in results] == list(range(count))
        depth, confidence = whole.depth[count - 1], whole.depth_confidence[count - 1]
        np.testing.assert_allclose([r.depth for r in results], depth[:count], rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose([r.confidence for r in results], confidence[:count], rtol=2e-5, atol=2e-5)
        cameras = session.cameras()
        assert cameras.is_final.all()
        # These encodings are up to 7 in size; what releases of XLA round differently adds up over four rounds.
        np.testing.assert_allclose(cameras.pose_encoding, encodings[:count, -1], rtol=1e-4, atol=3e-5)


def test_stream_equals_apply_for_every_length(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, whole: Predictions
) -> None:
    for count in range(1, 14):
        session = StreamSession(with_modes(small_config), small_variables, first_capacity=16)
        results = stream(session, frames[:count])
        assert [result.index for result in results] == list(range(count))
        expected = jax.tree.map(lambda x, row=count - 1, stop=count: x[row, :stop], whole)
        np.testing.assert_allclose([r.depth for r in results], expected.depth, rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose([r.confidence for r in results], expected.depth_confidence, rtol=2e-5, atol=2e-5)
        cameras = session.cameras()
        np.testing.assert_allclose(cameras.pose_encoding, expected.pose_encoding, rtol=1e-4, atol=2e-5)
        np.testing.assert_allclose(cameras.extrinsics, expected.extrinsics, rtol=1e-4, atol=3e-5)


@pytest.mark.parametrize(
    "mode",
    [
        {"enabled": False},
        {"context": 4},
        {"period": 5},
        {"period": 50},
        {"max_registers": 12},
        {"period": 2, "context": 3, "max_registers": 8},
        # Each of these is one of those above with another number, or leaves out a part of the last one.
        *(
            pytest.param(mode, marks=pytest.mark.slow)
            for mode in (
                {"period": 2},
                {"period": 2, "context": 3},
                {"period": 5, "context": 4},
                {"period": 3, "enabled": False, "context": 2},
                {"period": 3, "max_registers": 16},
            )
        ),
    ],
    ids=str,
)
def test_stream_equals_whole_in_every_refinement_mode(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, whole: Predictions, mode: dict
) -> None:
    model = with_modes(small_config, **mode)
    assert_equals_whole(model, small_variables, frames, whole, COUNTS, first_capacity=16)


@pytest.mark.slow
def test_stream_equals_whole_with_other_windows(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    model = with_modes(small_config, size=5, stride=2, period=3)
    expected = jax.jit(model.apply)(small_variables, frames[None, :8])
    session = StreamSession(model, small_variables, first_capacity=16)
    results = stream(session, frames[:8])
    np.testing.assert_allclose([r.depth for r in results], expected.depth[0], rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(session.cameras().pose_encoding, expected.pose_encoding[0], rtol=1e-4, atol=2e-5)


def test_buffers_that_grow_on_the_way_change_nothing(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, whole: Predictions
) -> None:
    model = with_modes(small_config, period=5)
    assert_equals_whole(model, small_variables, frames, whole, [13], first_capacity=8)


def test_frames_in_any_grouping(small_config: ModelConfig, small_variables: dict, frames: np.ndarray) -> None:
    model = with_modes(small_config)
    one_by_one = StreamSession(model, small_variables, first_capacity=16)
    expected = stream(one_by_one, frames)
    grouped = StreamSession(model, small_variables, first_capacity=16)
    results = grouped.push(frames[:1]) + grouped.push(frames[1:8]) + grouped.push(frames[8:])
    results += grouped.close()
    np.testing.assert_array_equal([r.depth for r in results], [r.depth for r in expected])
    np.testing.assert_array_equal(grouped.cameras().pose_encoding, one_by_one.cameras().pose_encoding)


def test_depth_comes_as_soon_as_its_last_window_is_done(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    session = StreamSession(with_modes(small_config), small_variables, first_capacity=16, ahead=0)
    final = [len(session.push(frame)) for frame in frames[:9]]
    assert final == [0, 0, 0, 2, 0, 2, 0, 2, 0]
    assert len(session.close()) == 3
    assert session.close() == []


def test_a_window_ahead_delays_the_results_and_changes_nothing(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    """The device works on a window while the caller has the results of the one before."""
    model = with_modes(small_config, period=2)
    sessions = [StreamSession(model, small_variables, first_capacity=16, ahead=ahead) for ahead in (0, 1)]
    counts = [[len(session.push(frame)) for frame in frames[:9]] for session in sessions]
    assert counts[1] == [0, 0, 0, 0, 0, 2, 0, 2, 0]
    results = [session.push(frames[9:]) + session.close() for session in sessions]
    assert [len(each) for each in results] == [7, 9]
    for at_once, later in zip(results[0], results[1][2:], strict=True):
        assert (at_once.index, at_once.pose_is_final) == (later.index, later.pose_is_final)
        np.testing.assert_array_equal(at_once.depth, later.depth)
        np.testing.assert_array_equal(at_once.pose_encoding, later.pose_encoding)
    np.testing.assert_array_equal(sessions[0].cameras().extrinsics, sessions[1].cameras().extrinsics)


@pytest.mark.parametrize("mode", [{"enabled": False}, {"period": 5}, {"context": 4}], ids=str)
def test_other_modes_on_the_same_windows_are_streams_of_their_own(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, mode: dict
) -> None:
    session = StreamSession(with_modes(small_config), small_variables, first_capacity=16)
    stream(session, frames)
    own = StreamSession(with_modes(small_config, **mode), small_variables, first_capacity=16)
    stream(own, frames)
    cameras = session.cameras_with(with_modes(small_config, **mode).config.refinement)
    np.testing.assert_allclose(cameras.pose_encoding, own.cameras().pose_encoding, rtol=1e-4, atol=2e-5)
    assert cameras.is_final.all()
    assert len(session.cameras().extrinsics) == len(frames)


def test_loops_are_closed_beside_refinement(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the closer makes of the stream's cameras is what comes out, whichever the refinement."""
    closers: list[LoopCloser] = []

    def close(self: LoopCloser, cameras: Cameras) -> Cameras:
        closers.append(self)
        assert all(place.depth is not None for place in self._places.values())
        return cameras._replace(depth_scale=cameras.extrinsics[:, 0, 3])

    monkeypatch.setattr(LoopCloser, "close", close)
    model = with_modes(small_config)
    plain = StreamSession(model, small_variables, first_capacity=16)
    session = StreamSession(model, small_variables, first_capacity=16, loops=LoopSettings(spacing=3))
    expected, results = stream(plain, frames), stream(session, frames)
    np.testing.assert_array_equal([r.depth for r in results], [r.depth for r in expected])
    assert not any(result.pose_is_final for result in results)
    for refinement in (model.config.refinement, with_modes(small_config, context=4).config.refinement):
        found, without = session.cameras_with(refinement), plain.cameras_with(refinement)
        np.testing.assert_array_equal(found.extrinsics, without.extrinsics)
        np.testing.assert_array_equal(found.depth_scale, without.extrinsics[:, 0, 3])
    np.testing.assert_array_equal(session.cameras().depth_scale, plain.cameras().extrinsics[:, 0, 3])
    assert session.cameras().is_final.all()
    # Both places in one window of four.
    assert list(closers[0]._places) == [0, 3, 6, 9, 12] and closers[0]._settings.frames == 2


def test_online_poses_are_final_with_the_depth_and_never_move(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    session = StreamSession(with_modes(small_config, period=2), small_variables, first_capacity=16)
    results = stream(session, frames)
    assert all(result.pose_is_final for result in results)
    np.testing.assert_array_equal(
        np.stack([result.pose_encoding for result in results]), session.cameras().pose_encoding
    )


@pytest.mark.parametrize("mode", [{}, {"period": 4}], ids=str)
def test_provisional_poses_are_those_of_a_stream_that_ends_there(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, whole: Predictions, mode: dict
) -> None:
    model = with_modes(small_config, **mode)
    session = StreamSession(model, small_variables, first_capacity=16, provisional=True, ahead=0)
    results = session.push(frames[:8])
    assert len(results) == 6
    assert results[-1].pose_encoding is not None
    assert not results[-1].pose_is_final
    provisional = session.cameras(provisional=True)
    frozen = mode.get("period", 0)
    assert provisional.is_final.tolist() == [True] * frozen + [False] * (6 - frozen)
    assert len(session.cameras().is_final) == frozen
    # The tokens at hand, those of frames whose last window is done, refined as a sequence of their own.
    tokens, registers = whole.camera_tokens[7:8], whole.register_tokens[7:8]
    expected = np.asarray(refine(model, small_variables, tokens, registers, np.arange(13)[None] < 6))
    np.testing.assert_allclose(provisional.pose_encoding, expected[0, :6, -1], rtol=1e-4, atol=2e-5)
    # Asking must not change what follows.
    rest = session.push(frames[8:]) + session.close()
    assert len(rest) == 7
    tokens, registers = whole.camera_tokens[12:], whole.register_tokens[12:]
    expected = np.asarray(refine(model, small_variables, tokens, registers, LENGTHS[12:]))
    np.testing.assert_allclose(session.cameras().pose_encoding, expected[0, :, -1], rtol=1e-4, atol=2e-5)


def test_nothing_compiles_per_frame_and_the_state_does_not_grow(
    small_config: ModelConfig, small_variables: dict
) -> None:
    model = with_modes(small_config, period=2, context=3)
    session = StreamSession(model, small_variables, first_capacity=64)
    frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    session.push(np.stack([frame] * 8))

    def compiled() -> list[int]:
        programs = (session_module._step, pose_stream._fire)
        return [program._cache_size() for program in programs]

    def state_bytes() -> int:
        return sum(leaf.nbytes for leaf in jax.tree.leaves(session._state))

    before, size, capacity = compiled(), state_bytes(), session._poses._store.capacity
    for _ in range(40):
        session.push(frame)
    assert compiled() == before
    assert state_bytes() == size
    assert session._poses._store.capacity == capacity == 64
    assert len(session._pending) < 2


@pytest.mark.parametrize(
    ("method", "settings", "names"),
    [("windows", None, ("_start", "_step")), ("chunks", ChunkPlan(3, 1), ("_predict",))],
)
def test_what_is_compiled_meanwhile_is_what_a_stream_begins_with(
    method: str,
    settings: Any,
    names: tuple[str, ...],
    small_config: ModelConfig,
    small_variables: dict,
    caplog: pytest.LogCaptureFixture,
) -> None:
    model, found, size = with_modes(small_config), METHODS[method], (42, 14)  # sizes that no other test compiles for

    def compiled_for(size: tuple[int, int]) -> set[str]:
        predictor = open_predictor(method, model, small_variables, settings)
        caplog.clear()
        with jax.log_compiles():
            for frame in np.zeros((4, *size, 3), np.uint8):
                predictor.push(frame)
        return {name for name in names for each in caplog.messages if f"XLA compilation of jit({name})" in each}

    with compiled_meanwhile(lambda: found.opening(model, size, found.chosen(settings), 10)):
        pass
    assert not compiled_for(size)
    assert compiled_for(size[::-1]) == set(names)


def test_what_fails_meanwhile_is_left_to_the_stream() -> None:
    def lower() -> list[jax.stages.Lowered]:
        raise MemoryError

    with compiled_meanwhile(lower):
        pass
    with pytest.raises(InputError, match="no weights"), compiled_meanwhile(lower):
        raise InputError("no weights")


def test_programs_grow_with_the_logarithm_of_a_stream_that_reads_everything(
    small_config: ModelConfig, small_variables: dict
) -> None:
    """Buffers double: from 4 frames to 32 there are four sizes, and no more programs than that."""
    session = StreamSession(with_modes(small_config, period=2), small_variables, first_capacity=4)
    frame, before = np.zeros((HEIGHT, WIDTH, 3), np.uint8), pose_stream._fire._cache_size()
    for _ in range(30):
        session.push(frame)
    session.close()
    assert len(session.cameras().is_final) == 30
    assert session._poses._store.capacity == 32
    assert pose_stream._fire._cache_size() - before <= 4


def test_a_state_grows_by_compact_tokens_alone(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    """A frame's camera token, the same refined, and keys and values of its four registers, of 2C numbers each."""
    session, found = StreamSession(with_modes(small_config), small_variables), []
    assert session.state_bytes == 0
    for frame in frames[:12]:
        session.push(frame)
        found.append(session.state_bytes)
    assert found[0] == HEIGHT * WIDTH * 3, "a picture that waits for its window"
    compact = 4 * 2 * small_config.encoder.embed_dim * (1 + 1 + 2 * 4)
    assert np.diff(found[3::2]).tolist() == [2 * compact] * 4
    session.close()


def test_an_empty_stream_has_no_frames(small_config: ModelConfig, small_variables: dict) -> None:
    session = StreamSession(with_modes(small_config), small_variables, first_capacity=16)
    assert session.close() == []
    assert session.cameras().extrinsics.shape == (0, 3, 4)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros((30, 42, 3), np.float32), "multiples of 14"),
        (np.zeros((28, 42), np.float32), r"\[n, H, W, 3\]"),
        (np.zeros((28, 42, 3), np.int32), "int32"),
        (np.zeros((42, 28, 3), np.float32), "alike"),
        (np.zeros((28, 42, 3), np.uint8), "alike"),
    ],
)
def test_bad_frames_are_named(small_config: ModelConfig, small_variables: dict, bad: np.ndarray, message: str) -> None:
    session = StreamSession(with_modes(small_config), small_variables, first_capacity=16)
    session.push(np.zeros((28, 42, 3), np.float32))
    with pytest.raises(ValueError, match=message):
        session.push(bad)


def test_a_closed_session_takes_no_frames(small_config: ModelConfig, small_variables: dict) -> None:
    session = StreamSession(with_modes(small_config), small_variables, first_capacity=16)
    session.close()
    with pytest.raises(ValueError, match="closed"):
        session.push(np.zeros((28, 42, 3), np.float32))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ahead": -1}, "ahead must be an integer of at least 0, got -1"),
        ({"ahead": 0.5}, "ahead must be an integer of at least 0, got 0.5"),
        ({"first_capacity": 0}, "first_capacity must be a positive integer, got 0"),
    ],
)
def test_settings_out_of_range_are_the_users(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=rf"WindowSettings\.{message}"):
        WindowSettings(**options)


def test_options_by_name_take_the_place_of_settings(small_config: ModelConfig, small_variables: dict) -> None:
    model, settings = with_modes(small_config), WindowSettings(ahead=0, first_capacity=4)
    assert StreamSession(model, small_variables, settings)._settings == settings
    by_name = StreamSession(model, small_variables, settings, provisional=True)
    assert by_name._settings == WindowSettings(provisional=True, ahead=0, first_capacity=4)
    with pytest.raises(TypeError, match="unknown"):
        StreamSession(model, small_variables, unknown=1)


@pytest.mark.parametrize("method", ["windows", "offline", "chunks", "causal"])
def test_whoever_pushes_frames_may_use_one_buffer_for_all(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray, method: str
) -> None:
    expected, found = (
        open_predictor(method, with_modes(small_config), small_variables, METHODS[method].settings()) for _ in range(2)
    )
    buffer, results, wanted = np.empty_like(frames[0]), [], []
    for frame in frames[:4]:
        buffer[...] = frame
        results += found.push(buffer)
        wanted += expected.push(frame.copy())
    buffer[...] = 0
    results += found.close()
    wanted += expected.close()
    assert len(results) == len(wanted) == 4
    for result, other in zip(results, wanted, strict=True):
        np.testing.assert_array_equal(result.depth, other.depth)


def test_what_is_done_to_results_does_nothing_to_the_stream(
    small_config: ModelConfig, small_variables: dict, frames: np.ndarray
) -> None:
    session = StreamSession(with_modes(small_config, period=2), small_variables, ahead=0)
    for result in (result for frame in frames[:8] for result in session.push(frame)):
        if result.pose_encoding is not None:
            with pytest.raises(ValueError, match="read-only"):
                result.pose_encoding[:3] *= 100
    before = session.cameras()
    kept = before.pose_encoding.copy()
    before.pose_encoding[:, :3] *= 100
    np.testing.assert_array_equal(session.cameras().pose_encoding, kept)
