"""Association by time: one partner each, the closest first, within the tolerance."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from logvggt_jax.data.readers.timed_rgbd import associate

TIMES = st.lists(st.floats(0, 1, allow_nan=False), max_size=12).map(sorted).map(np.array)


def test_the_closest_become_partners_and_no_entry_has_two():
    first = np.array([1.000, 1.010, 1.050, 2.0])
    second = np.array([1.009, 1.045, 1.048, 3.0])
    # 1.000 is nearest to 1.009 too, but that belongs to 1.010.
    np.testing.assert_array_equal(associate(first, second), [-1, 0, 2, -1])
    np.testing.assert_array_equal(associate(second, first), [1, -1, 2, -1])


def test_the_tolerance_is_two_hundredths_of_a_second():
    np.testing.assert_array_equal(associate(np.array([1.0, 5.0]), np.array([1.0199, 5.0201])), [0, -1])


@settings(deadline=None)
@given(TIMES, TIMES)
def test_no_two_left_apart_are_closer_than_their_partners(first: np.ndarray, second: np.ndarray):
    partners = associate(first, second, 0.1)
    matched = partners[partners >= 0]
    assert len(set(matched)) == len(matched)
    gap_of_first = np.full(len(first), np.inf)
    gap_of_second = np.full(len(second), np.inf)
    for row, column in enumerate(partners):
        if column >= 0:
            gap_of_first[row] = gap_of_second[column] = abs(first[row] - second[column])
    assert ((gap_of_first < 0.1) | np.isinf(gap_of_first)).all()
    # A pair left apart within the tolerance has, on one side, a partner at least as close.
    gaps = np.abs(np.subtract.outer(first, second))
    near = gaps < 0.1
    assert (~near | (gap_of_first[:, None] <= gaps) | (gap_of_second[None] <= gaps)).all()
