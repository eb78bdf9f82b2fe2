"""Key-value caches that keep what the newest queries look for (XStreamVGGT, without training), in 16 or 4 bits.

A frame attends to the cache and to itself; then it joins the cache, and where the cache holds more than `cap` tokens it
is pruned. The first frame's tokens and the newest frame's stay. Those between are scored by the newest frame's
queries, of which the special tokens' count one by one and the patches' in means of 16:

    score_i = mean_r( q̄_r ) · k̄_i,      both averaged over the heads,

and the best stay, the same ones in every head, in the order of time. Two frames always fit: with a smaller cap the
cache holds the first frame and the newest. In the camera head's trunk a frame is one token.

In 4 bits the whole cache is coded over again with every frame, before it is pruned, as the original does it: its groups
of keys (see `quantisation.py`) are of neighbours in the cache, which change. What pruning leaves of a group keeps the
group's scale, so that the packed cache stands for the very numbers of the original, which stores them unpacked.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from logvggt_jax.model.key_value_cache import KeyValueCache
from logvggt_jax.model.memory import Attend, Keys, LayerMemory, OwnTokens, Project
from logvggt_jax.model.padding import with_places
from logvggt_jax.model.quantisation import (
    GROUP,
    decoded,
    encoded_keys,
    encoded_values,
    num_groups,
    packed,
    unpacked,
)

# Patches whose queries count as one.
_POOL = 16


@struct.dataclass
class PrunedCache(KeyValueCache):
    """A cache that keeps at most as many tokens as its capacity, which is at least two frames once it is full.

    Attributes:
      special: static, a frame's tokens that count one by one as queries; all where a frame has no more.
    """

    special: int = struct.field(pytree_node=False)

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        """See `LayerMemory`; pruning comes after attention."""
        del project
        stored, new = self.opened(own.keys.key.dtype), own.keys
        key, value = (_appended(x, fresh, self.length) for x, fresh in zip(stored, (new.key, new.value), strict=True))
        count = self.length + new.key.shape[1]
        taken = attention(own.query, Keys(key, value, jnp.broadcast_to(count, key.shape[:1])))
        return taken, self.closed(own.query, key, value, count)

    def opened(self, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """The keys and values, [B, capacity, heads, head_dim] each."""
        del dtype
        return self.key, self.value

    def closed(self, query: jax.Array, key: jax.Array, value: jax.Array, count: jax.Array) -> PrunedCache:
        """The cache of what stays of a frame's and earlier tokens.

        Args:
          query: [B, N, heads, head_dim] of the newest frame.
          key: [B, capacity + N, heads, head_dim], of which the first `count` count.
          value: likewise.
          count: int32 scalar.
        """
        kept = choose_kept(query, key, count, special=self.special, keep=self.capacity)
        return self.replace(  # type: ignore[attr-defined]
            key=_taken(key, kept), value=_taken(value, kept), length=jnp.minimum(count, self.capacity)
        )


@struct.dataclass
class PackedPrunedCache(PrunedCache):
    """The same in 4 bits.

    Attributes:
      key: uint8 [B, capacity, heads, head_dim / 2], two codes a byte.
      value: likewise.
      tokens: static, N, a frame's tokens.
      group: int32 [B, capacity], the group of a token's key.
      key_scale: float32 [B, groups, heads, head_dim], of the groups of capacity + N tokens before the last pruning.
      key_zero: uint8, likewise.
      value_scale: float32 [B, capacity, heads, 1].
      value_zero: uint8, likewise.
    """

    tokens: int = struct.field(pytree_node=False)
    group: jax.Array
    key_scale: jax.Array
    key_zero: jax.Array
    value_scale: jax.Array
    value_zero: jax.Array

    def grown(self, room: int) -> PackedPrunedCache:
        """See `KeyValueCache.grown`."""
        per_token = ("key", "value", "group", "value_scale", "value_zero")
        arrays = {name: with_places(getattr(self, name), room, axis=1) for name in per_token}
        more = num_groups(self.capacity + room + self.tokens) - self.key_scale.shape[1]
        arrays |= {name: with_places(getattr(self, name), more, axis=1) for name in ("key_scale", "key_zero")}
        return self.replace(**arrays)  # type: ignore[attr-defined]

    def opened(self, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """The keys and values that the codes stand for."""
        scale, zero = (_taken(x, self.group) for x in (self.key_scale, self.key_zero))
        key = decoded(unpacked(self.key), scale, zero)
        value = decoded(unpacked(self.value), self.value_scale, self.value_zero)
        return key.astype(dtype), value.astype(dtype)

    def closed(self, query: jax.Array, key: jax.Array, value: jax.Array, count: jax.Array) -> PrunedCache:
        """Codes all tokens, then prunes by what the codes of the keys stand for."""
        counts = (jnp.arange(key.shape[1]) < count)[:, None, None]
        keys, values = encoded_keys(jnp.where(counts, key, 0)), encoded_values(value)

        def of_tokens(grouped: jax.Array) -> jax.Array:
            return grouped.reshape(grouped.shape[0], -1, *grouped.shape[3:])[:, : key.shape[1]]

        seen = of_tokens(keys.numbers()).astype(key.dtype)
        kept = choose_kept(query, seen, count, special=self.special, keep=self.capacity)
        return self.replace(  # type: ignore[attr-defined]
            key=packed(_taken(of_tokens(keys.code), kept)),
            value=packed(_taken(values.code, kept)),
            length=jnp.minimum(count, self.capacity),
            group=kept // GROUP,
            key_scale=keys.scale[:, :, 0],
            key_zero=keys.zero[:, :, 0],
            value_scale=_taken(values.scale, kept),
            value_zero=_taken(values.zero, kept),
        )


def empty_packed(shape: tuple[int, ...], *, special: int, tokens: int) -> PackedPrunedCache:
    """A packed cache [B, capacity, heads, head_dim] for frames of so many tokens that has seen nothing."""
    batch, capacity, heads, width = shape
    groups = num_groups(capacity + tokens)
    key, value = (jnp.zeros((batch, capacity, heads, width // 2), jnp.uint8) for _ in range(2))
    return PackedPrunedCache(
        key=key,
        value=value,
        length=jnp.zeros((), jnp.int32),
        special=special,
        tokens=tokens,
        group=jnp.zeros((batch, capacity), jnp.int32),
        key_scale=jnp.zeros((batch, groups, heads, width), jnp.float32),
        key_zero=jnp.zeros((batch, groups, heads, width), jnp.uint8),
        value_scale=jnp.zeros((batch, capacity, heads, 1), jnp.float32),
        value_zero=jnp.zeros((batch, capacity, heads, 1), jnp.uint8),
    )


def choose_kept(query: jax.Array, key: jax.Array, count: jax.Array, *, special: int, keep: int) -> jax.Array:
    """Which tokens of a cache stay: int32 [B, keep], their places in rising order, then places that do not count.

    Args:
      query: [B, N, heads, head_dim] of the newest frame, whose tokens are the last N that count.
      key: [B, M, heads, head_dim].
      count: int32 scalar, how many of the M tokens count, always the first ones.
      special: see `PrunedCache`.
      keep: how many stay, static; all that count where they are not more.
    """
    tokens, place = query.shape[1], jnp.arange(key.shape[1])
    protected = (place < tokens) | (place >= count - tokens)
    ranked = jnp.where(protected, jnp.inf, scores_of(query, key, special=special))
    ranked = jnp.where(place < count, ranked, -jnp.inf)
    return jnp.sort(jax.lax.top_k(ranked, keep)[1], axis=1)


def scores_of(query: jax.Array, key: jax.Array, *, special: int) -> jax.Array:
    """How much a frame's queries [B, N, heads, head_dim] look for keys [B, M, heads, head_dim]; float32 [B, M]."""
    query = query.astype(jnp.float32).mean(2)
    batch, patches, width = query[:, special:].shape
    runs = -(-patches // _POOL)
    padded = jnp.pad(query[:, special:], ((0, 0), (0, runs * _POOL - patches), (0, 0)))
    # The last run may be shorter, and weighs as much as another.
    sizes = np.minimum(_POOL, patches - _POOL * np.arange(runs))
    pooled = padded.reshape(batch, runs, _POOL, width).sum(2) / sizes[:, None]
    proxy = jnp.concatenate([query[:, :special], pooled], axis=1).mean(1)
    return jnp.einsum("bnd,bd->bn", key.astype(jnp.float32).mean(2), proxy, precision="highest")


def _appended(stored: jax.Array, new: jax.Array, length: jax.Array) -> jax.Array:
    """[B, capacity + N, …] with the N new tokens after the first `length` that are stored."""
    roomy = with_places(stored, new.shape[1], axis=1)
    return jax.lax.dynamic_update_slice_in_dim(roomy, new.astype(stored.dtype), length, axis=1)


def _taken(x: jax.Array, places: jax.Array) -> jax.Array:
    """[B, K, …] of [B, N, …] at places [B, K]."""
    return jnp.take_along_axis(x, places.reshape(*places.shape, *(1,) * (x.ndim - 2)), axis=1)
