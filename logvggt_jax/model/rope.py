"""2-D rotary position embedding of patch positions (VGGT: base 100, first half of a head y, second half x)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class RopeTable(NamedTuple):
    """Cosines and sines of one frame's tokens, float32 [P, head_dim / 4] for each of y and x."""

    cos_y: jax.Array
    sin_y: jax.Array
    cos_x: jax.Array
    sin_x: jax.Array


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

    return RopeTable(spread(0, np.cos), spread(0, np.sin), spread(1, np.cos), spread(1, np.sin))


def apply_rope(tokens: jax.Array, table: RopeTable) -> jax.Array:
    """Rotates queries or keys [B, n · P, heads, head_dim] of n frames in float32; returns their dtype.

    Positions know the inside of a frame only: every frame is rotated alike.
    """
    batch, length, heads, head_dim = tokens.shape
    frames = tokens.astype(jnp.float32).reshape(batch, -1, len(table.cos_y), heads, head_dim)
    y1, y2, x1, x2 = jnp.split(frames, 4, axis=-1)
    cos_y, sin_y, cos_x, sin_x = (part[:, None, :] for part in table)
    rotated = jnp.concatenate(
        [
            y1 * cos_y - y2 * sin_y,
            y2 * cos_y + y1 * sin_y,
            x1 * cos_x - x2 * sin_x,
            x2 * cos_x + x1 * sin_x,
        ],
        axis=-1,
    )
    return rotated.reshape(batch, length, heads, head_dim).astype(tokens.dtype)
