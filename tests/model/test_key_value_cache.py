"""What caches keep: all, the first frame and a ring, or what a budget allows."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from logvggt_jax.model.key_value_cache import AnchoredCache, GrowingCache, KeyValueCache, empty
from logvggt_jax.model.memory import Keys
from logvggt_jax.model.rolling_cache import RollingCache, RollingMemory, budgets, choose_kept

TOKENS = 3


def frame_keys(frame: int, tokens: int = TOKENS) -> Keys:
    """Keys [1, tokens, 2, 4] that are the frame's number."""
    keys = np.full((1, tokens, 2, 4), frame, np.float32)
    return Keys(keys, -keys, None)


@jax.jit
def extended(cache: KeyValueCache, keys: Keys) -> tuple[Keys, KeyValueCache]:
    """One program for all frames."""
    return cache.extended(keys)


def frames_seen(keys: Keys) -> list[int]:
    """The numbers of the frames that a block attends to, each of whose tokens count."""
    keys = jax.device_get(keys)
    assert keys.valid is not None
    seen = keys.key[0, : int(keys.valid[0]), 0, 0]
    np.testing.assert_array_equal(-keys.value[0, : int(keys.valid[0]), 0, 0], seen)
    assert (seen.reshape(-1, TOKENS) == seen[::TOKENS, None]).all()
    return sorted(seen[::TOKENS].astype(int).tolist())


def test_a_growing_cache_keeps_all() -> None:
    cache = empty(GrowingCache, (1, 5 * TOKENS, 2, 4))
    for frame in range(5):
        keys, cache = extended(cache, frame_keys(frame))
        assert frames_seen(keys) == list(range(frame + 1))


@pytest.mark.parametrize("window", [1, 2, 5])
def test_an_anchored_cache_keeps_the_first_and_the_newest(window: int) -> None:
    """The first frame and the last `window`, the frame itself among them, as the mask form has it."""
    cache = empty(AnchoredCache, (1, (1 + window) * TOKENS, 2, 4))
    for frame in range(4 * window + 2):
        keys, cache = extended(cache, frame_keys(frame))
        assert frames_seen(keys) == sorted({0, *range(max(0, frame - window + 1), frame + 1)})


@pytest.mark.parametrize(("anchor", "budget"), [(0, 7), (4, 7), (4, 4), (4, 11)])
def test_what_stays_is_what_resembles_the_mean_least(anchor: int, budget: int) -> None:
    tokens, length, heads = 16, 12, 3
    key = np.random.default_rng(0).standard_normal((1, tokens, heads, 4)).astype(np.float32)
    choose = jax.jit(choose_kept, static_argnums=3)
    kept, mean = jax.device_get(choose(key, np.int32(length), np.int32(budget), anchor))
    scores = []
    for head in range(heads):
        unit = key[0, anchor:length, head] / np.linalg.norm(key[0, anchor:length, head], axis=1, keepdims=True)
        scores.append(unit @ unit.mean(0))
        lowest = np.sort(anchor + np.argsort(scores[-1])[: budget - anchor])
        expected = [*range(anchor), *lowest, *[tokens] * (tokens - budget)]
        np.testing.assert_array_equal(kept[0, :, head], expected)
    np.testing.assert_allclose(mean, np.mean(scores), atol=1e-6)


def test_published_budget() -> None:
    """1,200,000 tokens over 24 layers with equal scores are 50,000 each, exactly."""
    of_scores = jax.jit(budgets)
    assert set(of_scores(np.zeros(24, np.float32), 1_200_000, 0.5).tolist()) == {50_000}
    shares = np.exp((1 - np.array([0.0, 0.5])) / 0.5)
    np.testing.assert_array_equal(of_scores(np.float32([0.0, 0.5]), 1000, 0.5), np.floor(1000 * shares / shares.sum()))


def test_budgets_follow_from_the_frame_before_and_never_fall_below_the_anchor() -> None:
    cache = empty(GrowingCache, (1, 20, 2, 4))
    layer = RollingCache(cache.key, cache.value, cache.length, np.int32(0), np.float32(0), anchor=TOKENS)
    memory = RollingMemory((layer, layer), np.zeros(2, np.float32), total=16, temperature=0.2)
    assert [int(memory.at(i).budget) for i in range(2)] == [8, 8]
    memory = memory.updated(0, memory.at(0).replace(score=np.float32(0.9)))
    assert int(memory.at(1).budget) == 8, "the first layer's new score counts at the next frame"
    memory = memory.updated(1, memory.at(1))
    assert [int(memory.at(i).budget) for i in range(2)] == [TOKENS, 15], "the anchor alone, where less is left"
    unanchored = memory.replace(layers=tuple(layer.replace(anchor=0) for layer in memory.layers), temperature=1e-3)
    assert int(unanchored.at(0).budget) == 1, "never nothing, to which nothing could attend"
    # Frames come and the poor layer keeps the first one.
    cache = memory.at(0)
    for frame in range(3):
        keys, cache = extended(cache, frame_keys(frame))
        assert frames_seen(keys) == [0]
