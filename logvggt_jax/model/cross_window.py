"""Cross-window attention: what a window leaves behind at the key layers, and how the next window reads it.

Paper, equation of cross-window attention, at every key layer l of window i:

    H_i^(l+1) = F( Q(H_i^(l)), K([H_i^(l), C_{i−1}^(l)]), V([H_i^(l), C_{i−1}^(l)]) )

F is the block's own attention, with its own norm, projections, key norm and rotary embedding for both halves and no
parameter of its own; residual, MLP and LayerScale stay VGGT's. The paper leaves open what the cache C holds. Here
C_{i−1}^(l) are all tokens of the frames that windows i − 1 and i share, as the global block of layer l left them in
window i − 1 (`WindowConfig.cache = "output"`), or as that block met them (`"input"`). With inputs cached, every hop
from window to window climbs one key layer: frame 0 reaches as many later windows as there are key layers.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from flax import struct

from logvggt_jax.model.memory import Attend, FixedMemory, Keys, LayerMemory, OwnTokens, Project


@struct.dataclass
class CachedTokens:
    """C_{i−1}^(l) of one key layer.

    Attributes:
      tokens: [B, F, P, C], of the F frames that the windows share.
      length: int32 [B], how many of the F frames count, always the first ones; 0 before the first window.
      seen: bool [B, F, P], which of the tokens count; None for all.
    """

    tokens: jax.Array
    length: jax.Array
    seen: jax.Array | None = None

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        """Keys and values are [H, C]; the cache is replaced by the windows, not by the block."""
        batch, frames, tokens, width = self.tokens.shape
        cached = project(self.tokens.astype(jnp.float32).reshape(batch, frames * tokens, width))
        key, value, valid = own.keys
        if self.seen is not None:
            assert valid is not None  # the window's own tokens are masked as well
            there = self.seen & (jnp.arange(frames) < self.length[:, None])[..., None]
            both = Keys(
                jnp.concatenate([key, cached.key], axis=1),
                jnp.concatenate([value, cached.value], axis=1),
                jnp.concatenate([valid, there.reshape(batch, frames * tokens)], axis=1),
            )
            return attention(own.query, both), self
        if valid is None:
            joined, count = _cache_last, jnp.int32(key.shape[1])
        else:
            joined, count = functools.partial(_joined, empty=self.length == 0), valid
        keys = Keys(joined(key, cached.key), joined(value, cached.value), count + self.length * tokens)
        return attention(own.query, keys), self


@struct.dataclass
class CrossWindowMemory(FixedMemory):
    """The caches of all key layers.

    Attributes:
      tokens: [B, key layers, F, P, C].
      length: int32 [B], see `CachedTokens`.
      key_layers: static.
      seen: bool [B, F, P], see `CachedTokens`.
    """

    tokens: jax.Array
    length: jax.Array
    key_layers: tuple[int, ...] = struct.field(pytree_node=False)
    seen: jax.Array | None = None

    def at(self, layer: int) -> CachedTokens | None:
        """The cache of `layer`; None for layers that are not key layers."""
        if layer not in self.key_layers:
            return None
        return CachedTokens(self.tokens[:, self.key_layers.index(layer)], self.length, self.seen)


def _cache_last(own: jax.Array, cached: jax.Array) -> jax.Array:
    return jnp.concatenate([own, cached], axis=1)


def _joined(own: jax.Array, cached: jax.Array, empty: jax.Array) -> jax.Array:
    """Both halves [B, N + E, …] such that those that count come first: attention does not care for the order.

    The cache is whole or empty, and padding ends the window: before the window's own keys it leaves no gap but when
    it is empty, and then it goes to the end.
    """
    cache_first = jnp.concatenate([cached, own], axis=1)
    return jnp.where(empty[:, None, None, None], _cache_last(own, cached), cache_first)
