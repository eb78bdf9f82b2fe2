"""A key-value cache of bounded size that drops what resembles the average (InfiniteVGGT, without training).

Every layer has a budget of tokens a head, by how much its keys resembled one another at the last frame. With s_l the
mean score of layer l at its last eviction (0 before the first), at every frame

    b_l = ⌊ total · softmax_l((1 − s_l) / temperature) ⌋

A layer appends the frame's tokens, and where it then holds more than b_l it scores all but the anchor, the first
frame's, the newest tokens among them:

    k̂_i = k_i / ‖k_i‖,     c_i = k̂_i · mean_j k̂_j

Each head keeps the anchor and its b_l − A tokens of the lowest scores, in the order of time, and the frame attends to
what is left. A budget that grows refills with new tokens; what is evicted does not come back.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from logvggt_jax.model.key_value_cache import KeyValueCache
from logvggt_jax.model.memory import Keys, LayerMemory


@struct.dataclass
class RollingCache(KeyValueCache):
    """One layer's cache. All heads hold equally many tokens, each its own choice.

    Attributes:
      budget: int32 scalar, most tokens a head after a frame. The capacity holds them and one frame more.
      score: float32 scalar, mean score at the last eviction.
      anchor: static, the first so many tokens always stay.
    """

    budget: jax.Array
    score: jax.Array
    anchor: int = struct.field(pytree_node=False)

    def extended(self, new: Keys) -> tuple[Keys, KeyValueCache]:
        """What is left after the new tokens have come and some have gone, perhaps of the new ones."""
        key, value = self.written(new, self.length)
        length = self.length + new.key.shape[1]

        def evict(key: jax.Array, value: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            kept, score = choose_kept(key, length, self.budget, self.anchor)
            # Places beyond the budget point past the end: what is read there means nothing.
            index = jnp.minimum(kept, self.capacity - 1)[..., None]
            return jnp.take_along_axis(key, index, axis=1), jnp.take_along_axis(value, index, axis=1), score

        def keep(key: jax.Array, value: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            return key, value, self.score

        key, value, score = jax.lax.cond(length > self.budget, evict, keep, key, value)
        length = jnp.minimum(length, self.budget)
        cache = self.replace(key=key, value=value, length=length, score=score)  # type: ignore[attr-defined]
        return Keys(key, value, jnp.broadcast_to(length, key.shape[:1])), cache


@struct.dataclass
class RollingMemory:
    """The caches of all layers and what sets their budgets.

    Attributes:
      layers: one a layer.
      scores: float32 [layers], their scores when the frame before was done: budgets of a frame follow from these, for
        its first layer as for its last.
      total: static, tokens a head in all layers together.
      temperature: static.
    """

    layers: tuple[RollingCache, ...]
    scores: jax.Array
    total: int = struct.field(pytree_node=False)
    temperature: float = struct.field(pytree_node=False)

    def at(self, layer: int) -> RollingCache:
        """The cache of `layer` with its budget for this frame."""
        cache = self.layers[layer]
        # Below the anchor, where the original stops with an index error, the anchor alone stays; without an anchor one
        # token, since what attends to nothing takes in whatever lies in the empty places.
        budget = jnp.maximum(budgets(self.scores, self.total, self.temperature)[layer], max(cache.anchor, 1))
        return cache.replace(budget=budget)  # type: ignore[attr-defined]

    def updated(self, layer: int, memory: LayerMemory) -> RollingMemory:
        """With the cache that the block of `layer` left; after the last one the next frame's scores are known."""
        layers = (*self.layers[:layer], memory, *self.layers[layer + 1 :])
        scores = self.scores
        if layer == len(layers) - 1:
            scores = jnp.stack([cache.score for cache in layers])  # type: ignore[attr-defined]
        return self.replace(layers=layers, scores=scores)  # type: ignore[attr-defined]


def budgets(scores: jax.Array, total: int, temperature: float) -> jax.Array:
    """Tokens a head of each layer, int32, of the layers' scores; the product is float32, then truncated."""
    shares = jax.nn.softmax((1.0 - scores) / temperature)
    return (shares * jnp.float32(total)).astype(jnp.int32)


def choose_kept(key: jax.Array, length: jax.Array, budget: jax.Array, anchor: int) -> tuple[jax.Array, jax.Array]:
    """Which tokens of a cache stay, and the mean score of its candidates.

    Args:
      key: [B, N, heads, head_dim].
      length: int32 scalar, how many of the N count; more than `budget`.
      budget: int32 scalar, how many stay, at least `anchor`.
      anchor: how many of the first stay whatever their score.

    Returns:
      int32 [B, N, heads], the places of those that stay in rising order, then N; and a float32 scalar.
    """
    batch, tokens, heads, _ = key.shape
    place = jnp.arange(tokens)[:, None]
    candidate = (place >= anchor) & (place < length)
    scores = similarity_to_mean(key, candidate)
    mean = jnp.where(candidate, scores, 0.0).sum() / (candidate.sum() * batch * heads)
    ranked = jnp.where(candidate, scores, jnp.where(place < anchor, -jnp.inf, jnp.inf))
    lowest = jnp.argsort(ranked, axis=1)
    return jnp.sort(jnp.where(place < budget, lowest, tokens), axis=1), mean


def similarity_to_mean(key: jax.Array, candidate: jax.Array) -> jax.Array:
    """Scores [B, N, heads] of keys [B, N, heads, head_dim]: the unit key times the mean unit key of the candidates,
    bool [N, 1]."""
    key = key.astype(jnp.float32)
    unit = key / jnp.maximum(jnp.linalg.norm(key, axis=-1, keepdims=True), 1e-12)
    mean = jnp.where(candidate[..., None], unit, 0.0).sum(axis=1) / candidate.sum()
    return jnp.einsum("bnhd,bhd->bnh", unit, mean, precision="highest")
