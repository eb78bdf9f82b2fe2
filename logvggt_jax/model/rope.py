"""2-D rotary position embedding of patch positions (VGGT: base 100, first half of a head y, second half x)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class RopeTable(NamedTuple):
    """Rotations of one frame's P tokens, float32; axes are (y, x), then (first, second) of the rotated pair.

    Attributes:
      cos: [P, 2, 1, head_dim / 4].
      sin: [P, 2, 2, head_dim / 4], negative for the first of a pair.
    """

    cos: jax.Array
    sin: jax.Array


def rope_table(grid: tuple[int, int], num_special: int, head_dim: int, base: float) -> RopeTable:
    """The table of a frame's tokens: special tokens at position (0, 0), patch (row, column) at (row+1, column+1).

    Position 0 is not rotated. The program holds one row a grid line and spreads it over the grid by itself.
    """
    frequencies = base ** -(np.arange(head_dim // 4, dtype=np.float32) * np.float32(4.0 / head_dim))

    def spread(axis: int, wave: np.ufunc) -> jax.Array:
        angles = np.arange(1, grid[axis] + 1, dtype=np.float32)[:, None] * frequencies.astype(np.float32)
        lines = jnp.asarray(wave(angles))
        patches = jnp.broadcast_to(jnp.expand_dims(lines, 1 - axis), (*grid, len(frequencies)))
        special = jnp.full((num_special, len(frequencies)), wave(np.float32(0.0)))
        return jnp.concatenate([special, patches.reshape(-1, len(frequencies))])

    cos, sin = (jnp.stack([spread(axis, wave) for axis in (0, 1)], axis=1) for wave in (np.cos, np.sin))
    return RopeTable(cos[:, :, None], jnp.stack([-sin, sin], axis=2))


def apply_rope(tokens: jax.Array, table: RopeTable) -> jax.Array:
    """Rotates queries or keys [B, n · P, heads, head_dim] of n frames in float32; returns their dtype.

    Positions know the inside of a frame only: every frame is rotated alike.
    """
    batch, length, heads, head_dim = tokens.shape
    # [B, n, P, heads, (y, x), (first, second), head_dim / 4]
    pairs = tokens.astype(jnp.float32).reshape(batch, -1, len(table.cos), heads, 2, 2, head_dim // 4)
    # (a, b) becomes (a cos − b sin, b cos + a sin); a mirrored read, where a concatenation would be a copy.
    rotated = pairs * table.cos[:, None] + jnp.flip(pairs, axis=-2) * table.sin[:, None]
    return rotated.reshape(batch, length, heads, head_dim).astype(tokens.dtype)
