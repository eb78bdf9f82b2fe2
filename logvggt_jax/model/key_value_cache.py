"""Key-value caches: what blocks have seen of earlier frames, for streams that take one frame a call.

Keys are cached after norm and rotation. A token's position is its place inside its own frame, so that neither changes
as the sequence grows, and StreamVGGT's original, which normalises and rotates all cached keys over again at every
frame, gives the same numbers.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from logvggt_jax.model.gccr import RegisterKeys
from logvggt_jax.model.memory import Attend, Keys, LayerMemory, OwnTokens, Project, RoundMemory
from logvggt_jax.model.padding import with_places


@struct.dataclass
class KeyValueCache:
    """Keys and values of one block's earlier tokens; all items of a batch are equally long.

    Attributes:
      key: [B, capacity, heads, head_dim].
      value: [B, capacity, heads, head_dim].
      length: int32 scalar, how many of them count, always the first ones.
    """

    key: jax.Array
    value: jax.Array
    length: jax.Array

    @property
    def capacity(self) -> int:
        """Tokens that fit."""
        return self.key.shape[-3]

    def grown(self, room: int) -> KeyValueCache:
        """The same with so many more places, which are empty."""
        key, value = (with_places(x, room, axis=x.ndim - 3) for x in (self.key, self.value))
        return self.replace(key=key, value=value)  # type: ignore[attr-defined]

    def extended(self, new: Keys) -> tuple[Keys, KeyValueCache]:
        """What the N new tokens attend to, and the cache with them."""
        raise NotImplementedError

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        """See `LayerMemory`."""
        del project
        keys, cache = self.extended(own.keys)
        return attention(own.query, keys), cache

    def written(self, new: Keys, place: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Keys and values with the N new tokens from `place` on."""
        pairs = ((self.key, new.key), (self.value, new.value))
        key, value = (jax.lax.dynamic_update_slice_in_dim(old, fresh, place, axis=1) for old, fresh in pairs)
        return key, value


@struct.dataclass
class GrowingCache(KeyValueCache):
    """All earlier tokens (StreamVGGT). Whoever holds it makes room before a frame comes: `capacity` is static."""

    def extended(self, new: Keys) -> tuple[Keys, KeyValueCache]:
        """All tokens so far."""
        key, value = self.written(new, self.length)
        cache = self.replace(key=key, value=value, length=self.length + new.key.shape[1])  # type: ignore[attr-defined]
        return _keys_of(cache), cache


@struct.dataclass
class AnchoredCache(KeyValueCache):
    """The first frame's tokens, then a ring of the newest frames' (STream3R's window mode).

    Capacity is 1 + W frames. Frame f > 0 lies in the ring's place (f − 1) mod W: it replaces frame f − W before it
    attends, so that it sees the first frame and the last W with itself among them. `length` counts all tokens that
    have come, of which the cache holds the first 1 + W frames' worth or all of its places.
    """

    def extended(self, new: Keys) -> tuple[Keys, KeyValueCache]:
        """The first frame and the newest W."""
        tokens = new.key.shape[1]
        ring = self.capacity - tokens
        place = jnp.where(self.length == 0, 0, tokens + (self.length - tokens) % ring)
        key, value = self.written(new, place)
        cache = self.replace(key=key, value=value, length=self.length + tokens)  # type: ignore[attr-defined]
        return _keys_of(cache), cache


@struct.dataclass
class Caches:
    """A cache for every block of a stack."""

    layers: tuple[LayerMemory, ...]

    def at(self, layer: int) -> LayerMemory:
        """The cache of the block of `layer`."""
        return self.layers[layer]

    def updated(self, layer: int, memory: LayerMemory) -> Caches:
        """With another cache for the block of `layer`."""
        return Caches((*self.layers[:layer], memory, *self.layers[layer + 1 :]))


@struct.dataclass
class CameraMemory:
    """What a stream of single frames keeps for the poses of the frames to come.

    Attributes:
      trunk: caches of the camera head's trunk, one entry a frame (and round).
      registers: GCCR's keys and values of earlier frames, [B, capacity, 4, 2C] for the four registers of a frame, one
        entry a frame; None where GCCR is off.
    """

    trunk: RoundMemory
    registers: KeyValueCache | None


def with_registers(cache: KeyValueCache, new: RegisterKeys) -> tuple[RegisterKeys, jax.Array, KeyValueCache]:
    """The registers [B, n, 4, 2C] that a frame's camera token attends to, how many frames of them count, int32 [B],
    and the cache with the frame's own."""
    keys, cache = cache.extended(Keys(new.key, new.value, None))
    assert keys.valid is not None  # caches say how many count
    return RegisterKeys(keys.key, keys.value), keys.valid, cache


Cache = TypeVar("Cache", bound=KeyValueCache)


def empty(
    kind: type[Cache], shape: tuple[int, ...], dtype: str = "float32", *, rounds: int | None = None, **others: int
) -> Cache:
    """A cache of keys [B, capacity, heads, head_dim] that has seen nothing; one for each of `rounds`, if given.

    `others` are the fields that this kind of cache has besides.
    """
    leading = () if rounds is None else (rounds,)
    # Two buffers: a donated state holds none twice.
    key, value = (jnp.zeros((*leading, *shape), dtype) for _ in range(2))
    return kind(key, value, jnp.zeros(leading, jnp.int32), **others)


def _keys_of(cache: KeyValueCache) -> Keys:
    """All of a cache's tokens that count, for every item of the batch."""
    count = jnp.minimum(cache.length, cache.capacity)
    return Keys(cache.key, cache.value, jnp.broadcast_to(count, cache.key.shape[:1]))
