"""Which registers a bounded GCCR keeps: of the first frame, the newest, and some between; what is gone stays gone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.model.kept_registers import is_kept


def kept(count: int, max_frames: int) -> set[int]:
    return set(np.flatnonzero(is_kept(np.arange(count + 3), np.array(count), max_frames)).tolist())


@pytest.mark.parametrize("max_frames", [2, 3, 4, 7, 16])
def test_what_is_kept_fits_holds_both_ends_and_never_comes_back(max_frames: int) -> None:
    before: set[int] = set()
    for count in range(1, 300):
        now = kept(count, max_frames)
        assert len(now) <= max_frames
        assert count > max_frames or now == set(range(count))
        assert now >= {0, *range(max(0, count - max_frames // 2), count)}
        assert now <= before | {count - 1}
        before = now


def test_what_lies_between_is_evenly_spaced() -> None:
    between = sorted(kept(1000, 16) - set(range(992, 1000)))
    assert between == [0, 128, 256, 384, 512, 640, 768, 896]
    assert kept(40, 16) == {*range(0, 32, 4), *range(32, 40)}


def test_the_model_and_the_host_choose_alike() -> None:
    counts = np.array([1, 5, 8, 9, 31])
    expected = np.stack([is_kept(np.arange(40), np.array(count), 8) for count in counts])
    found = jax.jit(is_kept, static_argnums=2)(jnp.arange(40), jnp.asarray(counts)[:, None], 8)
    np.testing.assert_array_equal(found, expected)
