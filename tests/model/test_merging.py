"""Which tokens are merged, and what becomes of those that are not."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from logvggt_jax.model import merging as module
from logvggt_jax.model.memory import Keys, OwnTokens
from logvggt_jax.model.merging import merging_of


@pytest.mark.parametrize("grid", [(4, 6), (5, 7), (2, 3), (1, 4)])
def test_every_token_is_a_source_a_destination_or_protected(grid: tuple[int, int]) -> None:
    frames, special = 7, 5
    merging = merging_of(frames, grid, special, ratio=0.9, protected=0.1, similarity="float32")
    assert merging is not None
    per_frame = special + grid[0] * grid[1]
    total = frames * per_frame
    sources, destinations = set(merging.sources.tolist()), set(merging.destinations.tolist())
    protected = merging.protected.tolist()
    assert not sources & (destinations | set(protected))
    assert sources | destinations | set(protected) == set(range(total))
    assert len(protected) == total // 10 and len(set(np.diff(protected))) == 1
    assert set(range(per_frame)) <= destinations
    assert all(token % per_frame >= special for token in sources)
    # One patch of every whole cell, in every frame after the first.
    assert len(destinations) == per_frame + (frames - 1) * (special + (grid[0] // 2) * (grid[1] // 2))
    assert merging.merged == len(sources)


def test_the_least_similar_sources_attend_on_their_own() -> None:
    """Two tokens are merged: those that have a twin among the destinations. All others see themselves."""
    merging = merging_of(3, (2, 2), 1, ratio=2.2 / 15, protected=0, similarity="float32")
    assert merging is not None and merging.merged == 2
    x = np.random.default_rng(1).standard_normal((1, 15, 4)).astype(np.float32)
    twins = np.asarray(merging.sources)[[1, 4]], np.asarray(merging.destinations)[[0, 3]]
    x[0, twins[0]] = x[0, twins[1]]
    split = x[:, :, None]
    own = OwnTokens(x, split, Keys(split, split, None))

    def attention(query: jax.Array, keys: Keys) -> jax.Array:
        assert query.shape[1] == keys.key.shape[1] == 13
        return query

    taken, _ = jax.jit(lambda own: merging.attend(own, attention, lambda tokens: own.keys))(own)
    np.testing.assert_allclose(np.asarray(taken)[:, :, 0], x, rtol=1e-6)


def test_similarities_in_blocks_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    merging = merging_of(5, (4, 5), 5, ratio=0.9, protected=0.1, similarity="float32")
    assert merging is not None
    features = np.random.default_rng(2).standard_normal((125, 8)).astype(np.float32)

    def nearest() -> tuple[jax.Array, jax.Array]:
        """Traced anew, which is when blocks are made."""
        return jax.jit(lambda features: merging.nearest(features))(features)

    whole = nearest()
    monkeypatch.setattr(module, "_BLOCK_SIMILARITIES", 7 * len(merging.destinations))
    for found, expected in zip(nearest(), whole, strict=True):
        np.testing.assert_array_equal(found, expected)
