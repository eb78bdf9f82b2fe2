"""What is said of frames by their number and their sizes alone."""

from __future__ import annotations

import pytest

from logvggt_jax.frames import evenly_spaced, same_proportions


@pytest.mark.parametrize(
    ("size", "other", "alike"),
    [
        ((480, 640), (968, 1296), True),  # 0.4 % apart, as ScanNet's depth and colour are
        ((60, 80), (1440, 1920), True),
        ((480, 640), (640, 480), False),
        ((480, 640), (480, 660), False),
        ((640, 480), (660, 480), False),
    ],
)
def test_enlarged_or_reduced_is_told_from_squashed(size: tuple[int, int], other: tuple[int, int], alike: bool) -> None:
    assert same_proportions(size, other) == same_proportions(other, size) == alike
    assert same_proportions((*size, 3), other) == alike, "a picture's channels do not count"


def test_a_tolerance_is_a_share_of_the_aspect_ratio() -> None:
    assert same_proportions((100, 200), (100, 201), 0.006) and not same_proportions((100, 200), (100, 201), 0.004)


def test_frames_are_chosen_from_the_first_to_the_last() -> None:
    assert evenly_spaced(9, 3) == [0, 4, 8] and evenly_spaced(2, 5) == [0, 1] and evenly_spaced(5, 1) == [0]
