"""The value of a rank, against a sort."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from logvggt_jax.training.losses.order_statistics import order_statistic

SPECIAL = np.array([np.nan, -np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, -1e-45, 3.4e38, -3.4e38], np.float32)
ROWS, COUNT = 2, 12

selected = jax.jit(order_statistic)


@given(
    arrays(np.float32, (ROWS, COUNT), elements=st.one_of(st.floats(width=32), st.sampled_from([1.0, -1.0, 0.5]))),
    arrays(np.int32, (ROWS,), elements=st.integers(0, COUNT - 1)),
)
def test_it_is_what_a_sort_puts_there(values, rank):
    found = np.asarray(selected(values, rank))
    np.testing.assert_array_equal(found, np.take_along_axis(np.sort(values), rank[:, None], 1)[:, 0])


@pytest.mark.parametrize("rank", range(len(SPECIAL)))
def test_the_extremes_of_float32_are_in_order(rank):
    found = np.asarray(selected(SPECIAL[None], np.array([rank])))
    np.testing.assert_array_equal(found, np.sort(SPECIAL)[rank : rank + 1])


def test_many_values_need_no_sort():
    values = np.random.default_rng(0).standard_normal((2, 20_000)).astype(np.float32)
    rank = np.array([9_999, 3])
    np.testing.assert_array_equal(selected(values, rank), np.sort(values)[[0, 1], rank])
    assert "sort" not in jax.jit(order_statistic).lower(values, jnp.asarray(rank)).as_text()
