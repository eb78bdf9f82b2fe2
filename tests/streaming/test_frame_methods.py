"""Methods that take a frame a call: where they are one another, what they may see, and what they keep."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.compile import counted_compilations
from logvggt_jax.errors import InputError
from logvggt_jax.model.frame_by_frame import FrameByFrame
from logvggt_jax.streaming import (
    AnchoredWindowSettings,
    CausalSettings,
    FrameResult,
    MergedSettings,
    PredictionError,
    PrunedSettings,
    RollingSettings,
    frame_session,
    open_predictor,
)
from logvggt_jax.streaming.anchored_window import KeepWindow
from logvggt_jax.streaming.causal import KeepAll
from logvggt_jax.streaming.frame_session import FrameSession
from logvggt_jax.streaming.pruned import KeepWanted
from logvggt_jax.streaming.rolling import KeepWithinBudget
from logvggt_jax.streaming.state_file import save_stream

FRAMES, TOKENS, LAYERS, WIDTH = 9, 5 + 2 * 3, 4, 32
IMAGES = np.random.default_rng(0).integers(0, 256, (FRAMES, 28, 42, 3), np.uint8)
# Three frames a layer: evicts from the fourth on.
SMALL_BUDGET = RollingSettings(budget=3 * TOKENS * LAYERS)
# Three frames and a bit: prunes from the fourth on.
SMALL_CAP = 3 * TOKENS + 2


def opened(method: str, config: ModelConfig, variables: dict, settings: Any = None) -> FrameSession:
    return open_predictor(method, LogVGGT(config), variables, settings)  # type: ignore[return-value]


def run(method: str, config: ModelConfig, variables: dict, settings: Any = None, images: np.ndarray = IMAGES):
    predictor = opened(method, config, variables, settings)
    results = [result for image in images for result in predictor.push(image)] + predictor.close()
    assert [result.index for result in results] == list(range(len(images)))
    assert predictor.cameras().is_final.all()
    return results


def assert_alike(found: list[FrameResult], expected: list[FrameResult]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.depth, other.depth, rtol=2e-4)
        np.testing.assert_allclose(one.confidence, other.confidence, rtol=2e-4)
        np.testing.assert_allclose(one.pose_encoding, other.pose_encoding, rtol=0, atol=2e-5)


def assert_differ(found: FrameResult, expected: FrameResult) -> None:
    assert np.abs(found.pose_encoding - expected.pose_encoding).max() > 1e-3


@pytest.fixture(scope="module")
def causal(small_config: ModelConfig, small_variables: dict) -> list[FrameResult]:
    return run("causal", small_config, small_variables)


def test_causal_on_one_frame_is_vggt_on_one_frame(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    offline = open_predictor("offline", LogVGGT(small_config), small_variables)
    offline.push(IMAGES[0])
    (whole,) = offline.close()
    np.testing.assert_allclose(causal[0].depth, whole.depth, rtol=2e-4)
    # As the camera head gave it, quaternion and field of view as they are, whoever asks.
    np.testing.assert_allclose(causal[0].pose_encoding, whole.pose_encoding, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(offline.cameras().pose_encoding[0], whole.pose_encoding)
    stream = opened("causal", small_config, small_variables, CausalSettings(ahead=0))
    assert len(stream.push(IMAGES[0])) == 1, "with nothing ahead a frame's results come at once"
    np.testing.assert_allclose(stream.cameras().extrinsics, offline.cameras().extrinsics, atol=2e-5)


def test_causal_is_the_mask_form(small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]) -> None:
    out, encodings = jax.device_get(jax.jit(FrameByFrame(small_config).whole)(small_variables, IMAGES[None]))
    for index, result in enumerate(causal):
        np.testing.assert_allclose(result.depth, out.depth[0, index], rtol=2e-4)
        np.testing.assert_allclose(result.pose_encoding, encodings[0, index, -1], rtol=0, atol=2e-5)


def test_buffers_that_double_change_nothing(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    assert_alike(run("causal", small_config, small_variables, CausalSettings(first_capacity=2)), causal)


def test_one_camera_cache_is_another_model(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    """Depth knows nothing of it; poses differ from the first frame on, since rounds see earlier rounds."""
    single = run("causal", small_config, small_variables, CausalSettings("single"), IMAGES[:2])
    for one, other in zip(single, causal, strict=False):
        np.testing.assert_array_equal(one.depth, other.depth)
        assert_differ(one, other)


def test_an_anchored_window_is_causal_until_a_frame_leaves(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    assert AnchoredWindowSettings().window == 5
    found = run("anchored-window", small_config, small_variables, AnchoredWindowSettings(window=2))
    assert_alike(found[:3], causal[:3])
    assert_differ(found[3], causal[3])
    whole = run("anchored-window", small_config, small_variables, AnchoredWindowSettings(window=FRAMES))
    assert_alike(whole, causal)


def test_rolling_is_causal_until_it_evicts(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    assert_alike(run("rolling", small_config, small_variables), causal)
    found = run("rolling", small_config, small_variables, SMALL_BUDGET)
    assert_alike(found[:3], causal[:3])
    assert_differ(found[-1], causal[-1])


def test_pruned_is_causal_until_it_prunes(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    whole = PrunedSettings(cap=FRAMES * TOKENS, bits=16)
    assert_alike(run("pruned", small_config, small_variables, whole), causal)
    # Buffers that grow on the way change nothing.
    found = run("pruned", small_config, small_variables, PrunedSettings(SMALL_CAP, 16, first_capacity=2))
    assert_alike(found[:3], causal[:3])
    # A frame attends before it is pruned; of the registers it sees as many frames' as fit the cap.
    np.testing.assert_allclose(found[3].depth, causal[3].depth, rtol=2e-4)
    assert_differ(found[-1], causal[-1])


@pytest.mark.slow
def test_four_bits_are_another_model_from_the_second_frame_on(
    small_config: ModelConfig, small_variables: dict, causal: list[FrameResult]
) -> None:
    """A frame sees its own keys and values as they are, and older ones as they are stored."""
    found = run("pruned", small_config, small_variables, PrunedSettings(FRAMES * TOKENS))
    assert_alike(found[:1], causal[:1])
    assert_differ(found[1], causal[1])
    assert_alike(run("pruned", small_config, small_variables, PrunedSettings(FRAMES * TOKENS, first_capacity=1)), found)


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("causal", CausalSettings(first_capacity=2)),
        ("anchored-window", AnchoredWindowSettings(window=2)),
        ("rolling", SMALL_BUDGET),
        ("pruned", PrunedSettings(SMALL_CAP, 16)),
        pytest.param("pruned", PrunedSettings(SMALL_CAP, camera_cache="single"), marks=pytest.mark.slow),
    ],
)
def test_no_output_depends_on_a_later_frame(
    method: str, settings: Any, small_config: ModelConfig, small_variables: dict
) -> None:
    """Bit for bit; and the frames after a changed one do depend on it."""
    changed = IMAGES.copy()
    changed[5] = 255 - changed[5]
    before, after = (run(method, small_config, small_variables, settings, images) for images in (IMAGES, changed))
    for one, other in zip(before[:5], after[:5], strict=True):
        assert one.depth.tobytes() == other.depth.tobytes()
        assert one.pose_encoding.tobytes() == other.pose_encoding.tobytes()
    for one, other in zip(before[5:], after[5:], strict=True):
        assert_differ(one, other)


def camera_bytes(config: ModelConfig, frames: int) -> int:
    """Keys and values of every round and block of the trunk, and of GCCR's registers, float32."""
    head, width = config.camera_head, 2 * WIDTH
    return 4 * 2 * width * frames * (head.iterations * head.depth + config.aggregator.num_registers)


def test_bytes_of_the_state(small_config: ModelConfig, small_variables: dict) -> None:
    """Keys and values of all layers for each token kept; what is bounded stays as it is once it is full."""
    a_token = 2 * LAYERS * WIDTH * 4

    def bytes_by_frame(method: str, settings: Any = None) -> tuple[list[int], list[int]]:
        stream, found = opened(method, small_config, small_variables, settings), []
        for image in IMAGES:
            stream.push(image)
            found.append((stream.state_bytes, stream.allocated_bytes))
        return tuple(map(list, zip(*found, strict=True)))  # type: ignore[return-value]

    counts = range(1, FRAMES + 1)
    state, allocated = bytes_by_frame("causal", CausalSettings(first_capacity=2))
    assert state == [n * TOKENS * a_token + camera_bytes(small_config, n) for n in counts]
    camera = camera_bytes(small_config, frame_session.CAMERA_CAPACITY)
    assert allocated == [
        (2 if n <= 2 else 4 if n <= 4 else 8 if n <= 8 else 16) * TOKENS * a_token + camera for n in counts
    ]

    state, allocated = bytes_by_frame("anchored-window", AnchoredWindowSettings(window=2))
    kept = [min(n, 3) for n in counts]
    assert state == [n * TOKENS * a_token + camera_bytes(small_config, n) for n in kept]
    assert set(allocated) == {state[-1]}

    state, allocated = bytes_by_frame("rolling", SMALL_BUDGET)
    blocks = [bytes_ - camera_bytes(small_config, n) for bytes_, n in zip(state, counts, strict=True)]
    assert blocks[:3] == [n * TOKENS * a_token for n in (1, 2, 3)]
    most = SMALL_BUDGET.budget * a_token // LAYERS
    assert all(most - LAYERS * a_token // LAYERS <= bytes_ <= most for bytes_ in blocks[3:])
    assert len(set(allocated)) == 1


def test_bytes_of_a_pruned_state(small_config: ModelConfig, small_variables: dict) -> None:
    """Two codes a byte, a scale and a zero point for every 64 keys of a channel and for every token's values in a head,
    the number of its group for every token; registers of GCCR of as many frames as fit the cap."""
    camera = 4 * 2 * 2 * WIDTH * small_config.camera_head.iterations * small_config.camera_head.depth
    registers = 4 * 2 * 2 * WIDTH * small_config.aggregator.num_registers
    heads = small_config.aggregator.num_heads
    groups = -(-(SMALL_CAP + TOKENS) // 64)
    in_16_bits = 2 * LAYERS * WIDTH * 4 * SMALL_CAP
    in_4_bits = LAYERS * (SMALL_CAP * (WIDTH + 5 * heads + 4) + 5 * groups * WIDTH)
    for bits, expected in ((16, in_16_bits), (4, in_4_bits)):
        stream = opened("pruned", small_config, small_variables, PrunedSettings(SMALL_CAP, bits))
        found = []
        for image in IMAGES:
            stream.push(image)
            found.append(stream.state_bytes)
        full = [bytes_ - camera * n for n, bytes_ in enumerate(found, 1)][3:]
        assert full == [expected + 3 * registers] * len(full)


@pytest.mark.parametrize(
    ("keeping", "megabytes"),
    [
        (KeepAll(CausalSettings(first_capacity=1), 4), 102),
        (KeepWindow(5), 6 * 102),
        (KeepWithinBudget(RollingSettings(first_capacity=10**6), 4), 2 * 4_915 + 102),
        (KeepWanted(PrunedSettings(bits=16), 4), 205),
        (KeepWanted(PrunedSettings(), 4), 61),
    ],
)
def test_megabytes_at_the_size_of_vggt_1b(keeping: Any, megabytes: int) -> None:
    """Of all layers at 392 x 518 pixels in bfloat16, as published sizes and docs/methods.md have them; a budget with
    the room that it may need, and a frame."""
    blocks = jax.eval_shape(lambda: keeping.start(ModelConfig(dtype="bfloat16"), 1041).blocks)
    bytes_ = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(blocks) if leaf.ndim > 1)
    assert round(bytes_ / 1e6) == pytest.approx(megabytes, abs=2)


def test_one_program_serves_all_frames(small_config: ModelConfig, small_variables: dict) -> None:
    """Nothing compiles again but where buffers double: at 3, 5 and 9 frames of a cache that starts with two. Streams
    are three times as long as what the bounded ones keep; small programs of single operations count as well."""
    # A model of another configuration has compiled nothing yet. The step knows nothing of refinement: it counts, and is
    # yet read from the cache where another test had it compiled.
    config = dataclasses.replace(small_config, refinement=dataclasses.replace(small_config.refinement, enabled=False))
    for method, settings, compiling in (
        ("causal", CausalSettings(first_capacity=2), {0, 2, 4, 8}),
        ("anchored-window", AnchoredWindowSettings(window=2), {0}),
        ("rolling", SMALL_BUDGET, {0}),
        ("pruned", PrunedSettings(SMALL_CAP), {0}),
        ("pruned", PrunedSettings(SMALL_CAP, 16, first_capacity=2), {0, 2}),
    ):
        before = frame_session._step._cache_size(), frame_session._locate._cache_size()
        stream, counts = opened(method, config, small_variables, settings), [0]
        with counted_compilations() as compilations:
            for image in IMAGES:
                stream.push(image)
                counts.append(compilations.count)
            stream.close()
            counts[-1] = compilations.count
        assert set(np.flatnonzero(np.diff(counts))) == compiling, method
        assert frame_session._step._cache_size() - before[0] == len(compiling), method
        assert frame_session._locate._cache_size() - before[1] <= 1, method


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("causal", CausalSettings(first_capacity=2)),
        ("anchored-window", AnchoredWindowSettings(window=2)),
        ("rolling", SMALL_BUDGET),
        ("pruned", PrunedSettings(SMALL_CAP, camera_cache="single")),
    ],
)
def test_caches_are_given_to_the_step(
    method: str, settings: Any, small_config: ModelConfig, small_variables: dict
) -> None:
    """The buffers of before a frame are those of after it: no second cache is ever there."""
    stream = opened(method, small_config, small_variables, settings)
    stream.push(IMAGES[0])
    before = [leaf for leaf in jax.tree.leaves(stream._memory) if leaf.ndim > 1]
    places = {leaf.unsafe_buffer_pointer() for leaf in before}
    stream.push(IMAGES[1])
    assert all(leaf.is_deleted() for leaf in before)
    after = {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(stream._memory) if leaf.ndim > 1}
    assert after == places
    stream.close()


def test_a_layer_whose_budget_exceeds_its_share_gets_room(small_config: ModelConfig) -> None:
    """Capacities in frames as a layer fills up: doubled, twice the equal share and one, the largest budget and one."""
    keeping = KeepWithinBudget(dataclasses.replace(SMALL_BUDGET, first_capacity=2), rounds=4)
    memory, capacities = keeping.start(small_config, TOKENS), []
    for frames in range(9):
        full = memory.blocks.layers[0].replace(length=jnp.int32(frames * TOKENS))
        memory = keeping.make_room(memory._replace(blocks=memory.blocks.updated(0, full)), TOKENS, frames)
        capacities.append(memory.blocks.layers[0].capacity / TOKENS)
        assert len({layer.capacity for layer in memory.blocks.layers}) == 1
    largest = int(3 * LAYERS * TOKENS / (1 + 3 * np.exp(-2))) + 1
    assert capacities == [2, 2, 4, 4, 7, 7, 7, 1 + largest / TOKENS, 1 + largest / TOKENS]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (lambda: CausalSettings("shared"), "CausalSettings.camera_cache must be one of 'per_round', 'single'"),
        (lambda: CausalSettings(first_capacity=0), "CausalSettings.first_capacity must be a positive integer"),
        (lambda: AnchoredWindowSettings(window=0), "AnchoredWindowSettings.window must be a positive integer, got 0"),
        (lambda: AnchoredWindowSettings(window=2**62), "AnchoredWindowSettings.window must lie in"),
        (lambda: CausalSettings(first_capacity=2**62), "CausalSettings.first_capacity must lie in"),
        (lambda: PrunedSettings(first_capacity=2**62), "PrunedSettings.first_capacity must lie in"),
        (lambda: RollingSettings(first_capacity=2**62), "RollingSettings.first_capacity must lie in"),
        (lambda: PrunedSettings(cap=0), "PrunedSettings.cap must be a positive integer, got 0"),
        (lambda: PrunedSettings(bits=8), "PrunedSettings.bits must be one of 4, 16, got 8"),
        (lambda: RollingSettings(budget=0), "RollingSettings.budget must be a positive integer, got 0"),
        (lambda: RollingSettings(budget=2**31), "RollingSettings.budget must lie in"),
        (lambda: RollingSettings(temperature=0.0), "RollingSettings.temperature must lie in"),
        (lambda: RollingSettings(temperature=1e-38), "RollingSettings.temperature must lie in"),
        (lambda: RollingSettings(temperature=None), "RollingSettings.temperature must lie in"),
        (lambda: RollingSettings(budget=None), "RollingSettings.budget must be a positive integer, got None"),
        (lambda: PrunedSettings(cap=None), "PrunedSettings.cap must be a positive integer, got None"),
        (lambda: AnchoredWindowSettings(window=None), "AnchoredWindowSettings.window must be a positive integer, got"),
        (lambda: MergedSettings(ratio=None), "MergedSettings.ratio must lie in"),
        (lambda: RollingSettings(anchor=-1), "RollingSettings.anchor must be an integer of at least 0, got -1"),
    ],
)
def test_settings_that_mean_nothing(settings: Any, message: str) -> None:
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        settings()


@pytest.mark.parametrize("anchor", [0, 1, 3])
def test_a_budget_below_a_frame(anchor: int, small_config: ModelConfig, small_variables: dict) -> None:
    least = max(1, anchor) * TOKENS * LAYERS
    stream = opened("rolling", small_config, small_variables, RollingSettings(budget=least - 1, anchor=anchor))
    with pytest.raises(PredictionError, match=rf"budget: {least - 1} tokens leave .* take at least {least}$"):
        stream.push(IMAGES[0])
    assert stream.snapshot() == ([], {}), "a smaller frame may fit, and need not be like the one that was refused"


@pytest.mark.parametrize("anchor", [1, *(pytest.param(anchor, marks=pytest.mark.slow) for anchor in (0, 3))])
def test_the_least_budget_runs(anchor: int, small_config: ModelConfig, small_variables: dict) -> None:
    least = max(1, anchor) * TOKENS * LAYERS
    stream = opened("rolling", small_config, small_variables, RollingSettings(budget=least, anchor=anchor))
    stream.push(IMAGES[:2])
    assert len(stream.close()) >= 1


def test_a_cap_below_a_frame(small_config: ModelConfig, small_variables: dict) -> None:
    stream = opened("pruned", small_config, small_variables, PrunedSettings(cap=TOKENS - 1))
    with pytest.raises(PredictionError, match=rf"cap: {TOKENS - 1} tokens are fewer than .* at least {TOKENS}, or"):
        stream.push(IMAGES[0])
    stream = opened("pruned", small_config, small_variables, PrunedSettings(cap=TOKENS))
    for image in IMAGES:
        stream.push(image)
    # The first frame and the newest, whatever the cap.
    assert stream._memory is not None
    assert {int(cache.length) for cache in stream._memory.blocks.layers} == {2 * TOKENS}
    assert len(stream.close()) == 1


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        pytest.param("causal", CausalSettings(first_capacity=2), marks=pytest.mark.slow),
        ("rolling", RollingSettings(budget=2 * LAYERS * (5 + 1 * 2))),
        pytest.param("pruned", PrunedSettings(cap=16), marks=pytest.mark.slow),
    ],
)
def test_sequences_of_a_batch_do_not_meet(
    method: str, settings: Any, small_config: ModelConfig, small_variables: dict
) -> None:
    """Three at once, of pictures of another size, are what each is alone; `rolling` below its budget, since the budgets
    of its layers follow from the scores of the whole batch."""
    images = np.random.default_rng(3).integers(0, 256, (3, 2 if method == "rolling" else 4, 14, 28, 3), np.uint8)
    parts, tokens = FrameByFrame(small_config), 5 + 1 * 2
    step = jax.jit(parts.tokens)

    def run_batch(batch: np.ndarray) -> np.ndarray:
        keeping = opened(method, small_config, small_variables, settings)._keeping
        blocks = keeping.start(small_config, tokens, batch.shape[1]).blocks
        blocks = jax.tree.map(lambda x: jnp.repeat(x, len(batch), axis=0) if x.ndim > 1 else x, blocks)
        found = []
        for index in range(batch.shape[1]):
            first = jnp.full(len(batch), index == 0)
            out, blocks = step(small_variables, blocks, batch[:, index : index + 1], first)
            found.append(np.asarray(out.key))
        return np.stack(found, axis=1)

    together = run_batch(images)
    for index in range(len(images)):
        np.testing.assert_allclose(together[index], run_batch(images[index : index + 1])[0], rtol=1e-4, atol=2e-5)


def test_a_closed_stream_takes_no_frame(small_config: ModelConfig, small_variables: dict) -> None:
    stream = opened("causal", small_config, small_variables)
    assert stream.close() == [] and stream.cameras().extrinsics.shape == (0, 3, 4)
    with pytest.raises(ValueError, match="closed"):
        stream.push(IMAGES[0])


def test_a_stream_that_has_failed_says_so(
    small_config: ModelConfig, small_variables: dict, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its caches are gone: a state without them would take an earlier one's place."""

    def full(*_: Any) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    model, path = LogVGGT(small_config), tmp_path / "state.safetensors"
    stream = open_predictor("causal", model, small_variables)
    stream.push(IMAGES[:2])
    save_stream(path, stream, model, small_variables, method="causal")
    before = path.read_bytes()
    monkeypatch.setattr(frame_session, "_step", full)
    with pytest.raises(PredictionError, match=r"keeps of 2 frames .* did not fit"):
        stream.push(IMAGES[2])
    for use in (lambda: stream.push(IMAGES[2]), lambda: save_stream(path, stream, model, small_variables)):
        with pytest.raises(ValueError, match="this stream has failed: open another one"):
            use()
    assert path.read_bytes() == before and len(stream.close()) == 0
