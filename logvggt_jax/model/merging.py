"""Token merging (FastVGGT): blocks attend over fewer tokens, and give what these take in back to all of them.

In every global block each source token looks for the destination token most like it, by the cosine of the block's
normalised input. The most similar sources are merged: queries, keys and values of a destination become the mean of its
own and of those of its sources, and every source gets the destination's result. Which tokens are destinations is the
same for all blocks: all tokens of the first frame, the special tokens of every frame, and a patch of every 2 x 2 cell.
Protected tokens, every tenth or so, are never merged as sources and attend on their own; one that is a destination
stands twice among the keys, merged and alone. Merged keys carry no weight for what they stand for.

With an odd number of patches in a row the published code writes the pattern of the even part contiguously into the
raster, so that cells shear by a column a row and the last patches of a frame are all sources. It is kept, since weights
and published numbers know no other.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from logvggt_jax.model.memory import Attend, FixedMemory, Keys, OwnTokens, Project
from logvggt_jax.model.precision import product_precision

# Similarities of one block of sources: the whole matrix would be larger than attention's.
_BLOCK_SIMILARITIES = 2**26
# The published generator's seed; the pattern is drawn once and serves every layer.
_SEED = 33


@struct.dataclass
class TokenMerging(FixedMemory):
    """Which of N tokens are merged; see `merging_of`. Token numbers are frame · P + place.

    Attributes:
      sources: int32 [U], tokens that may be merged into others.
      destinations: int32 [D]; of equally similar ones the first is taken.
      protected: int32 [R], tokens that attend on their own.
      merged: how many of the U sources are merged, static; the least similar ones attend on their own.
      similarity: type in which cosines are compared, static: `bfloat16`, as published, or `float32`.
    """

    sources: jax.Array
    destinations: jax.Array
    protected: jax.Array
    merged: int = struct.field(pytree_node=False)
    similarity: str = struct.field(pytree_node=False)

    def at(self, layer: int) -> TokenMerging:
        """The same for every block."""
        del layer
        return self

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, TokenMerging]:
        """What rows [sources that are not merged, destinations, protected] take in of one another, spread to the N
        tokens, all of which have to count."""
        del project
        kept, merged, target = jax.vmap(self._assignment)(own.normed)

        def rows(x: jax.Array) -> jax.Array:
            return jax.vmap(self._mean)(kept, merged, target, x)

        taken = attention(rows(own.query), Keys(rows(own.keys.key), rows(own.keys.value), None))
        row_of = jax.vmap(self._row_of, in_axes=(0, 0, 0, None))(kept, merged, target, own.normed.shape[1])
        return jnp.take_along_axis(taken, row_of[..., None, None], axis=1), self

    def nearest(self, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of features [N, C] for each source its most similar destination: place among the destinations int32 [U], and
        cosine float32 [U]."""
        unit = features / jnp.linalg.norm(features, axis=-1, keepdims=True)
        unit = unit.astype(self.similarity)
        targets, precision = unit[self.destinations], product_precision(self.similarity)

        def block(sources: jax.Array) -> tuple[jax.Array, jax.Array]:
            cosines = jnp.einsum("sc,dc->sd", unit[sources], targets, precision=precision)
            return cosines.argmax(1).astype(jnp.int32), cosines.max(1).astype(jnp.float32)

        count = len(self.sources)
        blocks = -(-count * len(self.destinations) // _BLOCK_SIMILARITIES)
        size = -(-count // blocks)
        padded = jnp.pad(self.sources, (0, blocks * size - count)).reshape(blocks, size)
        place, cosine = jax.lax.map(block, padded)
        return place.reshape(-1)[:count], cosine.reshape(-1)[:count]

    def _assignment(self, features: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Tokens that are sources and are not merged [U − r], those that are [r], and the latter's destinations [r]."""
        place, cosine = self.nearest(features)
        if self.merged == len(self.sources):
            return self.sources[:0], self.sources, place
        order = jnp.argsort(-cosine)
        kept, merged = order[self.merged :], order[: self.merged]
        return self.sources[kept], self.sources[merged], place[merged]

    def _mean(self, kept: jax.Array, merged: jax.Array, target: jax.Array, x: jax.Array) -> jax.Array:
        """Rows [M, …] of tokens [N, …]."""
        sums = x[self.destinations].astype(jnp.float32).at[target].add(x[merged].astype(jnp.float32))
        counts = jnp.ones(len(self.destinations)).at[target].add(1.0)
        means = sums / counts.reshape(-1, *(1,) * (x.ndim - 1))
        return jnp.concatenate([x[kept], means.astype(x.dtype), x[self.protected]])

    def _row_of(self, kept: jax.Array, merged: jax.Array, target: jax.Array, tokens: int) -> jax.Array:
        """The row whose result each of N tokens gets, int32 [N]; a protected one its own."""
        first = len(kept)
        last = first + len(self.destinations)
        rows = jnp.zeros(tokens, jnp.int32)
        rows = rows.at[kept].set(jnp.arange(first)).at[self.destinations].set(jnp.arange(first, last))
        rows = rows.at[merged].set(first + target)
        return rows.at[self.protected].set(jnp.arange(last, last + len(self.protected)))


def merging_of(
    num_frames: int,
    grid: tuple[int, int],
    num_special: int,
    *,
    ratio: float,
    protected: float,
    similarity: str,
) -> TokenMerging | None:
    """The tokens of a sequence that are merged; None where none is.

    Args:
      num_frames: T.
      grid: (h, w) patches of a frame.
      num_special: tokens of a frame before its patches.
      ratio: share of all tokens that is merged, at most; sources are fewer than three quarters of them.
      protected: share of all tokens that is protected, at a uniform stride.
      similarity: see `TokenMerging`.
    """
    per_frame = num_special + grid[0] * grid[1]
    total = num_frames * per_frame
    is_destination = np.zeros((num_frames, per_frame), bool)
    is_destination[0] = True
    is_destination[:, :num_special] = True
    cells = _chosen_of_cells(num_frames - 1, grid)
    is_destination[1:, num_special : num_special + cells.shape[1]] = cells
    count = int(protected * total)
    protected_tokens = np.arange(0, total, total // count)[:count] if count else np.zeros(0, int)
    is_source = ~is_destination.reshape(-1)
    is_source[protected_tokens] = False
    merged = min(int(ratio * total), int(is_source.sum()))
    if not merged:
        return None

    def placed(tokens: np.ndarray) -> jax.Array:
        return jnp.asarray(tokens, jnp.int32)

    return TokenMerging(
        sources=placed(np.flatnonzero(is_source)),
        destinations=placed(np.flatnonzero(is_destination)),
        protected=placed(protected_tokens),
        merged=merged,
        similarity=similarity,
    )


def _chosen_of_cells(num_frames: int, grid: tuple[int, int]) -> np.ndarray:
    """Whether a patch is the one of its 2 x 2 cell, bool [frames, patches of whole cells] in their raster order."""
    rows, columns = grid[0] // 2, grid[1] // 2
    # PyTorch's generator on a CPU is this Mersenne twister, and its draws of 0 … 3 are its numbers modulo 4.
    draws = np.random.RandomState(_SEED).randint(0, 2**32, (num_frames, rows, columns), dtype=np.uint32) % 4
    chosen = np.zeros((num_frames, rows, 2, columns, 2), bool)
    frame, row, column = np.indices(draws.shape)
    chosen[frame, row, draws // 2, column, draws % 2] = True
    return chosen.reshape(num_frames, 4 * rows * columns)
