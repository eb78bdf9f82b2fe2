"""2-D rotary position embedding of patch positions (VGGT: base 100, first half of a head y, second half x)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class RopeTable(NamedTuple):
    """Cosines and sines, float32 [tokens, head_dim / 4] for each of y and x."""

    cos_y: np.ndarray
    sin_y: np.ndarray
    cos_x: np.ndarray
    sin_x: np.ndarray

    def tile(self, frames: int) -> RopeTable:
        """The table of `frames` frames one after the other: positions know the frame's inside only."""
        return RopeTable(*(np.tile(part, (frames, 1)) for part in self))


def rope_table(positions: np.ndarray, head_dim: int, base: float) -> RopeTable:
    """Table for integer positions [tokens, 2] (y, x); position 0 is not rotated."""
    frequencies = base ** -(np.arange(head_dim // 4, dtype=np.float32) * np.float32(4.0 / head_dim))
    angles = positions.astype(np.float32)[:, :, None] * frequencies.astype(np.float32)
    cos, sin = np.cos(angles), np.sin(angles)
    return RopeTable(cos[:, 0], sin[:, 0], cos[:, 1], sin[:, 1])


def frame_positions(grid: tuple[int, int], num_special: int) -> np.ndarray:
    """Positions [P, 2] of one frame's tokens: special tokens at (0, 0), patch (row, column) at (row+1, column+1)."""
    rows, columns = np.meshgrid(np.arange(grid[0]), np.arange(grid[1]), indexing="ij")
    patches = np.stack([rows.ravel(), columns.ravel()], axis=-1) + 1
    return np.concatenate([np.zeros((num_special, 2), patches.dtype), patches])


def apply_rope(tokens: jax.Array, table: RopeTable) -> jax.Array:
    """Rotates queries or keys [B, tokens, heads, head_dim] in float32; returns their dtype."""
    y1, y2, x1, x2 = jnp.split(tokens.astype(jnp.float32), 4, axis=-1)
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
    return rotated.astype(tokens.dtype)
