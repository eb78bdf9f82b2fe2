"""The seam: a global block attends to whatever object it is handed, here a causal key-value cache of a toy size."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from pieces import in_pieces

from logvggt_jax import ModelConfig
from logvggt_jax.model.aggregator import Aggregator
from logvggt_jax.model.cross_window import CrossWindowMemory
from logvggt_jax.model.memory import Attend, Keys, LayerMemory, OwnTokens, Project

GRID, WIDTH, FRAMES = (2, 3), 32, 3
TOKENS = 5 + GRID[0] * GRID[1]
NOTHING = CrossWindowMemory(np.zeros((1, 0), np.float32), np.zeros(1, np.int32), ())


@struct.dataclass
class LayerCache:
    """Keys and values of one layer's past frames, [B, capacity, heads, head_dim], the first `length` of them filled."""

    key: jax.Array
    value: jax.Array
    length: jax.Array

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        def write(cache: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(cache, new, self.length[0], axis=1)

        key, value, _ = own.keys
        longer = LayerCache(write(self.key, key), write(self.value, value), self.length + key.shape[1])
        return attention(own.query, Keys(longer.key, longer.value, longer.length)), longer


@struct.dataclass
class CausalCache:
    """A cache for every layer: a frame sees itself and all frames before it (StreamVGGT)."""

    layers: tuple[LayerCache, ...]

    def at(self, layer: int) -> LayerCache:
        return self.layers[layer]

    def updated(self, layer: int, memory: LayerMemory) -> CausalCache:
        return CausalCache((*self.layers[:layer], memory, *self.layers[layer + 1 :]))  # type: ignore[arg-type]


def empty_cache(config: ModelConfig) -> CausalCache:
    heads = config.aggregator.num_heads
    zeros = np.zeros((1, FRAMES * TOKENS, heads, WIDTH // heads), np.float32)
    return CausalCache(tuple(LayerCache(zeros, zeros, np.zeros(1, np.int32)) for _ in range(config.aggregator.depth)))


@pytest.fixture(scope="module")
def patch_tokens() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((1, FRAMES, GRID[0] * GRID[1], WIDTH)).astype(np.float32)


def test_a_causal_cache_stands_where_cross_window_attention_does(
    small_config: ModelConfig, small_variables: dict, patch_tokens: np.ndarray
) -> None:
    """Frame by frame through the cache: the past moves a frame, the future does not, and one frame is VGGT."""
    params = {"params": small_variables["params"]["aggregator"]}

    @in_pieces
    def frame(tokens: jax.Array, first: jax.Array, memory: CausalCache | CrossWindowMemory):
        return Aggregator(small_config).apply(params, tokens, jnp.ones(1, jnp.int32), first, memory, grid=GRID)

    def stream(tokens: np.ndarray) -> list[np.ndarray]:
        memory, outputs = empty_cache(small_config), []
        for index in range(FRAMES):
            out, memory = frame(tokens[:, index : index + 1], np.array([index == 0]), memory)
            outputs.append(np.asarray(out.special)[0, 0])
        assert [int(np.asarray(layer.length)[0]) for layer in memory.layers] == [FRAMES * TOKENS] * len(memory.layers)
        return outputs

    before = stream(patch_tokens)
    after = stream(patch_tokens * np.float32([1, -1, 1])[:, None, None])
    np.testing.assert_array_equal(before[0], after[0])
    assert np.abs(before[1] - after[1]).max() > 1e-3
    assert np.abs(before[2] - after[2]).max() > 1e-4, "frame 2 sees frame 1 through the cache alone"

    alone, _ = frame(patch_tokens[:, :1], np.array([True]), NOTHING)
    np.testing.assert_allclose(before[0], np.asarray(alone.special)[0, 0], rtol=1e-5, atol=1e-5)


def test_a_full_causal_cache_is_full_attention_over_the_last_frame(
    small_config: ModelConfig, small_variables: dict, patch_tokens: np.ndarray
) -> None:
    """All frames at once through an empty cache: every frame sees every other, as in one window."""
    params = {"params": small_variables["params"]["aggregator"]}

    @in_pieces
    def window(memory: CausalCache | CrossWindowMemory) -> jax.Array:
        lengths, first = jnp.full(1, FRAMES), jnp.array([True])
        return Aggregator(small_config).apply(params, patch_tokens, lengths, first, memory, grid=GRID)[0].key

    outputs = [window(memory) for memory in (empty_cache(small_config), NOTHING)]
    np.testing.assert_allclose(outputs[0], outputs[1], rtol=2e-5, atol=2e-5)
