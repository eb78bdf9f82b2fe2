"""A cache pruned by the newest queries, in 16 bits and 4, gives XStreamVGGT's numbers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from golden_methods import POSES, TOKENS, Golden, assert_depth, frame_step

from logvggt_jax.model import pruned_cache
from logvggt_jax.model.layers import Attention
from logvggt_jax.model.memory import OwnTokens
from logvggt_jax.model.parameters import run
from logvggt_jax.model.pruned_cache import PackedPrunedCache, PrunedCache, empty_packed, scores_of
from logvggt_jax.model.quantisation import encoded_keys, encoded_values, packed, unpacked
from logvggt_jax.model.rope import RopeTable, rope_table
from logvggt_jax.streaming.pruned import KeepWanted, PrunedSettings


@pytest.fixture(scope="module")
def golden(golden_dir: Path) -> Golden:
    return golden_methods.load(golden_dir, "pruned")


@pytest.fixture(scope="module")
def golden_quantised(golden_dir: Path) -> Golden:
    return golden_methods.load(golden_dir, "pruned", "quant")


class Choice(NamedTuple):
    """What one layer's pruning saw and did at one frame.

    Attributes:
      kept: places that stay, then places that do not count.
      scores: of all places.
      count: how many places counted.
    """

    kept: np.ndarray
    scores: np.ndarray
    count: int


_choices: list[Choice] = []


@pytest.fixture(autouse=True, scope="module")
def _record_choices() -> Iterator[None]:
    """Every pruning of a global block is noted; before any program is traced."""
    choose = pruned_cache.choose_kept

    def recorded(query: jax.Array, key: jax.Array, count: jax.Array, *, special: int, keep: int) -> jax.Array:
        kept = choose(query, key, count, special=special, keep=keep)
        if query.shape[1] > 1:  # not the camera head's, of one token a frame
            scores = scores_of(query, key, special=special)
            jax.debug.callback(lambda *x: _choices.append(Choice(*x)), kept[0], scores[0], count, ordered=True)
        return kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pruned_cache, "choose_kept", recorded)
        yield


def _streamed(golden: Golden, settings: PrunedSettings) -> Any:
    """Numbers of all frames, what was kept after each, and the choices of each frame by layer."""
    images, config, tokens = golden.arrays["images_u8"], golden.config, golden.settings["tokens_per_frame"]
    keeping = KeepWanted(settings, config.camera_head.iterations)
    memory, numbers, kept, choices = keeping.start(config, tokens, len(images)), [], [], []
    for index, image in enumerate(images):
        memory = keeping.make_room(memory, tokens, index)
        _choices.clear()
        memory, found = frame_step(config, golden.variables, memory, image, np.array([index == 0]))
        numbers.append(jax.device_get(found))
        kept.append(jax.device_get(memory))
        jax.effects_barrier()
        choices.append(jax.tree.map(np.asarray, list(_choices)))
    return jax.tree.map(lambda *x: np.concatenate(x), *numbers), kept, choices


def _kept_tokens(caches: list[PrunedCache], tokens: int) -> list[list[int]]:
    """Numbers frame · P + place of the tokens that a layer's cache held after each frame, from the keys themselves."""
    known: dict[bytes, int] = {}
    found = []
    for frame, cache in enumerate(caches):
        rows = [row.tobytes() for row in cache.key[0, : int(cache.length)]]
        known |= {row: frame * tokens + place for place, row in enumerate(rows[-tokens:])}
        found.append([known[row] for row in rows])
    return found


def _expected_kept(arrays: np.ndarray) -> list[list[int]]:
    return [[int(token) for token in row if token >= 0] for row in arrays]


def _assert_entries(caches: list[PrunedCache], numbers: np.ndarray, rounds: int) -> None:
    """Caches of the camera head hold the entries 4 · frame + round: those that a frame adds are new, and every number
    stands for the same key as long as it stays."""
    known: dict[int, bytes] = {}
    for frame, (cache, row) in enumerate(zip(caches, _expected_kept(numbers), strict=True)):
        assert len(row) == int(cache.length)
        for number, key in zip(row, cache.key[0], strict=False):
            assert (number in known) == (number < rounds * frame)
            assert known.setdefault(number, key.tobytes()) == key.tobytes()


@pytest.mark.parametrize(
    ("name", "cap"),
    [
        ("mid", "cap_middle"),
        pytest.param("deg", "cap_degenerate", marks=pytest.mark.slow),
        pytest.param("cam", "cap_camera", marks=pytest.mark.slow),
    ],
)
def test_golden_values_in_16_bits(golden: Golden, name: str, cap: str) -> None:
    arrays = golden.arrays
    found, kept, choices = _streamed(golden, PrunedSettings(golden.settings[cap], 16, "single"))
    np.testing.assert_allclose(found["poses"].swapaxes(0, 1), arrays[f"{name}_pose_enc"], rtol=0, atol=POSES)
    camera = [memory.camera.trunk.shared.layers for memory in kept]
    lengths = arrays["cam_cache_len"] if name == "cam" else arrays[f"{name}_camera_cache_len"]
    np.testing.assert_array_equal([caches[0].length for caches in camera], lengths)
    lengths = arrays["cam_global_cache_len"] if name == "cam" else arrays[f"{name}_cache_len"]
    np.testing.assert_array_equal([memory.blocks.layers[0].length for memory in kept], lengths)
    if name == "cam":
        for block in range(golden.config.camera_head.depth):
            rounds = golden.config.camera_head.iterations
            _assert_entries([caches[block] for caches in camera], arrays["cam_kept_entries"][:, block], rounds)
        return
    for i, layer in enumerate(golden.settings["layers"]):
        expected = arrays[f"{name}_tokens_{layer:02d}"]
        tokens = found["tokens"][:, i]
        tokens = tokens if expected.shape[1] == tokens.shape[1] else tokens[:, arrays["token_index"]]
        np.testing.assert_allclose(tokens, expected, rtol=0, atol=TOKENS, err_msg=f"block {layer}")
    for key in ("depth", "depth_conf"):
        assert_depth(found[key], arrays[f"{name}_{key}"])
    for i, layer in enumerate(golden.settings["detail_layers"]):
        caches = [memory.blocks.layers[layer] for memory in kept]
        tokens_kept = _kept_tokens(caches, golden.settings["tokens_per_frame"])
        assert tokens_kept == _expected_kept(arrays[f"{name}_kept_tokens"][:, i])
        if name == "mid":
            final = caches[-1].key[0].swapaxes(0, 1)
            np.testing.assert_allclose(final, arrays[f"mid_final_key_{layer:02d}"], rtol=0, atol=TOKENS)
    if name == "mid":
        _assert_scores(golden, choices)


def _assert_scores(golden: Golden, choices: list[list[Choice]]) -> None:
    """Scores of the middle in some layers, and the margin of the selection in all."""
    arrays, tokens, pruned = golden.arrays, golden.settings["tokens_per_frame"], 0
    for frame, by_layer in enumerate(choices):
        for layer, choice in enumerate(by_layer):
            stored = arrays["mid_score_gap"][frame, layer]
            if not np.isfinite(stored):
                assert choice.count <= len(choice.kept)
                continue
            middle = np.arange(tokens, choice.count - tokens)
            stays = np.isin(middle, choice.kept)
            scores = choice.scores[middle]
            gap = scores[stays].min() - scores[~stays].max()
            np.testing.assert_allclose(gap, stored, rtol=0, atol=2 * TOKENS)
            if layer in golden.settings["detail_layers"]:
                expected = arrays["mid_scores"][frame, golden.settings["detail_layers"].index(layer)]
                assert np.isfinite(expected).sum() == len(scores)
                np.testing.assert_allclose(scores, expected[: len(scores)], rtol=0, atol=TOKENS)
                pruned += 1
    assert pruned, "the sequence must be long enough to be pruned"


def _attention_of(golden: Golden, layer: int, width: int) -> tuple[Attention, dict, RopeTable]:
    """A global block's attention of tokens of this width, its parameters, and the rotations of a frame's tokens."""
    sizes, images = golden.config.aggregator, golden.arrays["images_u8"]
    module = Attention(sizes.num_heads, width, True, "float32", "xla")
    params = golden.variables["params"]["aggregator"][f"global_block_{layer}"]["attention"]
    grid = (images.shape[1] // 14, images.shape[2] // 14)
    return module, params, _rope_table(grid, 5, width // sizes.num_heads, sizes.rope_base)


_rope_table = jax.jit(rope_table, static_argnums=(0, 1, 2, 3))


def _heads_last(x: np.ndarray) -> np.ndarray:
    """[heads, N, width] to [1, N, heads, width]."""
    return x.swapaxes(0, 1)[None]


@struct.dataclass
class _Given(PackedPrunedCache):
    """A packed cache that stands for given numbers: of the original's cache the groups are not stored."""

    past_key: jax.Array
    past_value: jax.Array

    def opened(self, dtype: Any) -> tuple[jax.Array, jax.Array]:
        return self.past_key, self.past_value


@pytest.mark.parametrize("prefix", ["mid", "quant"])
def test_golden_steps_of_an_attention(golden: Golden, golden_quantised: Golden, prefix: str) -> None:
    """One frame in one layer, with the cache that it was given: its output, and the cache that it leaves."""
    names = sorted(name[:-2] for name in golden.arrays if name.startswith(f"{prefix}_step_") and name.endswith("_x"))
    assert names
    for name in names:
        _assert_step(golden, golden_quantised if prefix == "quant" else golden, prefix, name)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _stepped(
    module: Attention, packs: bool, params: Any, rope: RopeTable, x: jax.Array, key: jax.Array, value: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """Normalised tokens [1, P, C] through an attention whose cache holds these numbers: its output, and what the cache
    holds after it."""
    length = jnp.int32(key.shape[1])
    if packs:
        packed = empty_packed(key.shape, special=5, tokens=x.shape[1])
        fields = {field.name: getattr(packed, field.name) for field in dataclasses.fields(packed)}
        cache: PrunedCache = _Given(**{**fields, "length": length}, past_key=key, past_value=value)
    else:
        cache = PrunedCache(key, value, length, 5)

    def attend(query: jax.Array, keys: Any) -> jax.Array:
        return run(module, params, query, keys, method=Attention.attend)

    own = OwnTokens(x, *run(module, params, x, rope, method=Attention.project))
    taken, left = cache.attend(own, attend, lambda tokens: own.keys)
    numbers = PackedPrunedCache.opened(left, "float32") if packs else left.opened("float32")
    return run(module, params, taken), numbers


def _assert_step(golden: Golden, of: Golden, prefix: str, step: str) -> None:
    stored = {key: golden.arrays[f"{step}_{key}"] for key in ("x", "out", "past_k", "past_v", "new_k", "new_v")}
    layer = int(step.split("_l")[1].split("_")[0])
    module, params, rope = _attention_of(of, layer, stored["x"].shape[-1])
    past = _heads_last(stored["past_k"]), _heads_last(stored["past_v"])
    out, found = _stepped(module, prefix == "quant", params, rope, stored["x"][None], *past)
    np.testing.assert_allclose(out[0], stored["out"], rtol=0, atol=TOKENS)
    for numbers, name in zip(found, ("new_k", "new_v"), strict=True):
        difference = np.abs(np.asarray(numbers) - _heads_last(stored[name]))
        # In 4 bits a code that differs is a whole step of its group off, far above this: all codes are the same.
        assert difference.max() <= TOKENS


def test_golden_scores(golden: Golden) -> None:
    (name,) = (name[:-2] for name in golden.arrays if name.startswith("mid_step_") and name.endswith("_x"))
    layer, frame = (int(part[1:]) for part in name.split("_")[2:4])
    x = golden.arrays[f"{name}_x"]
    module, params, rope = _attention_of(golden, layer, x.shape[-1])
    query, _ = run(module, params, x[None], rope, method=Attention.project)
    past = _heads_last(golden.arrays[f"{name}_past_k"])[:, golden.settings["tokens_per_frame"] :]
    scores = jax.jit(functools.partial(scores_of, special=5))(query, past)[0]
    expected = golden.arrays["mid_scores"][frame, golden.settings["detail_layers"].index(layer)]
    np.testing.assert_allclose(scores, expected[: len(scores)], rtol=0, atol=TOKENS)


def test_golden_codes(golden: Golden) -> None:
    """The bare quantiser: codes and zero points exactly, scales and what they stand for to the last digits."""
    arrays = golden.arrays
    for name, encode in (("k", encoded_keys), ("v", encoded_values)):
        numbers = arrays[f"unit_{name}"]

        @jax.jit
        def codes_of(given: jax.Array, encode: Any = encode) -> tuple[jax.Array, ...]:
            codes = encode(given)
            return codes.code, codes.scale, codes.zero, codes.numbers()

        def coded(
            given: np.ndarray, codes_of: Any = codes_of, shape: tuple[int, ...] = numbers.shape
        ) -> list[np.ndarray]:
            wide = [np.asarray(x) for x in codes_of(given)]
            flat = [np.broadcast_to(x, wide[0].shape).reshape(1, -1, shape[0], shape[2]) for x in wide]
            return [x[0, : shape[1]].swapaxes(0, 1) for x in flat]

        code, scale, zero, out = coded(_heads_last(numbers))
        np.testing.assert_array_equal(code, arrays[f"unit_{name}_code"])
        np.testing.assert_array_equal(zero, arrays[f"unit_{name}_zero"])
        np.testing.assert_allclose(scale, arrays[f"unit_{name}_scale"], rtol=1e-6)
        np.testing.assert_allclose(out, arrays[f"unit_{name}_out"], rtol=1e-6)
        *_, twice = coded(_heads_last(arrays[f"unit_{name}_out"]))
        np.testing.assert_allclose(twice, arrays[f"unit_{name}_out_twice"], rtol=1e-6)
        halves = jax.jit(packed)(code)
        assert halves.nbytes == code.size // 2
        np.testing.assert_array_equal(jax.jit(unpacked)(halves), code)


def test_coding_again_rounds_ties_as_ieee_arithmetic_does() -> None:
    """Multiples of a step over a range of 10 steps lie midway between two of the 15 levels, every second of them."""
    generator = np.random.default_rng(0)
    steps = generator.uniform(0.05, 0.2, (1, 1, 2, 64)).astype(np.float32)
    numbers = generator.integers(-7, 4, (1, 64, 2, 64)).astype(np.float32) * steps
    low, high = numbers.min(1, keepdims=True), numbers.max(1, keepdims=True)
    scale = (high - low) / np.float32(15)
    zero = np.clip(np.round(-low / scale), 0, 15)
    expected = np.clip(np.round(numbers / scale) + zero, 0, 15)
    np.testing.assert_array_equal(jax.jit(encoded_keys)(jnp.asarray(numbers)).code[:, 0], expected)


@functools.partial(jax.jit, static_argnums=0)
def _coded_and_back(encode: Any, numbers: jax.Array) -> jax.Array:
    return encode(numbers).numbers()


def test_golden_caches_before_and_after_coding(golden: Golden) -> None:
    names = sorted(name[:-3] for name in golden.arrays if name.startswith("quant_l") and name.endswith("_in"))
    assert names
    for name in names:
        given = _heads_last(golden.arrays[f"{name}_in"])
        encode = encoded_keys if name.endswith("_k") else encoded_values
        found = np.asarray(_coded_and_back(encode, given)).reshape(1, -1, *given.shape[2:])[:, : given.shape[1]]
        expected = _heads_last(golden.arrays[f"{name}_out"])
        # A code that differed would be a whole step of its group off.
        assert np.abs(found - expected).max() <= TOKENS


@pytest.mark.parametrize(
    "name",
    [pytest.param("quantall", marks=pytest.mark.slow), pytest.param("quantoff", marks=pytest.mark.slow), "quant"],
)
def test_golden_values_in_4_bits(golden_quantised: Golden, name: str) -> None:
    """Loose where rounding to 4 bits decides ties, and pruning chooses by what came of it; tight where it does not."""
    arrays, sizes = golden_quantised.arrays, golden_quantised.settings["quant_config"]
    cap = sizes["cap"] if name == "quant" else 10**6
    settings = PrunedSettings(cap, 16 if name == "quantoff" else 4, "single")
    found, kept, choices = _streamed(golden_quantised, settings)
    tokens, poses, depth = (TOKENS, POSES, TOKENS) if name == "quantoff" else (2e-3, 2e-4, 5e-4)
    # A code that rounding tips over changes what pruning keeps, as it does in the original between two precisions.
    exact = 4 if name == "quant" else len(found["poses"])
    last, half = sizes["layers"][-1], slice(None, None, 2)
    pairs = [
        (found["tokens"][:, -1][:, arrays["token_index"]], arrays[f"{name}_tokens_{last:02d}"], tokens, 3e-2),
        (found["poses"], arrays[f"{name}_pose_enc"].swapaxes(0, 1), poses, 1e-2),
        (found["depth"][:, half, half], arrays[f"{name}_depth"], depth, 2e-2),
    ]
    if f"{name}_depth_conf" in arrays:
        pairs.append((found["depth_conf"][:, half, half], arrays[f"{name}_depth_conf"], depth, 2e-2))
    for numbers, expected, early, late in pairs:
        np.testing.assert_allclose(numbers[:exact], expected[:exact], rtol=1e-5, atol=early)
        assert (np.abs(numbers - expected) > late).mean() < 1e-3
    if name != "quantoff":
        lengths = [memory.blocks.layers[0].length for memory in kept]
        np.testing.assert_array_equal(lengths, arrays[f"{name}_cache_len"])
    if name == "quant":
        _assert_kept(golden_quantised, choices[:exact])


def _assert_kept(golden: Golden, choices: list[list[Choice]]) -> None:
    """Token numbers that every layer keeps, as long as they do not follow from ties."""
    expected, tokens = golden.arrays["quant_kept_tokens"], golden.settings["tokens_per_frame"]
    held: list[list[int]] = [[] for _ in range(expected.shape[1])]
    for frame, by_layer in enumerate(choices):
        for layer, choice in enumerate(by_layer):
            known = [*held[layer], *range(frame * tokens, (frame + 1) * tokens)]
            assert choice.count == len(known)
            held[layer] = [known[place] for place in choice.kept if place < len(known)]
        assert held == _expected_kept(expected[frame])
