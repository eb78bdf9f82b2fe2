"""Names of files give the order, the moments and the gaps of a sequence."""

import random

import pytest

from logvggt_jax.data.formats.ordering import missing_numbers, natural_order, time_stamps


@pytest.mark.parametrize(
    "names",
    [
        ["img1", "img2", "img9", "img10", "img100"],
        ["1548266469.88868", "1548266469.9022", "1548266469.93558", "1548266469.95", "1548266470.0"],
        ["0.5", "1.0", "1.25", "1.5", "10.0"],
        ["v1.2_003", "v1.9_001", "v1.10_001", "v1.10_002"],
        ["frame-000001.left", "frame-000001.right", "frame-000002.left"],
        ["a", "a1", "a1b", "a2", "b"],
        ["1403636579.763555584", "1403636579.763555585"],
        ["A1", "a2", "A3"],
        ["-10.5", "-2", "-0.50", "0.5", "1.5"],
        ["-1", "a-1"],
    ],
)
def test_order_is_natural_and_knows_decimals(names: list[str]) -> None:
    shuffled = random.Random(0).sample(names, len(names))
    assert [shuffled[position] for position in natural_order(shuffled)] == names


@pytest.mark.parametrize(
    ("names", "seconds"),
    [
        (["0.0", "0.5", "1.25"], [0.0, 0.5, 1.25]),
        (["1305031452.791720", "1305031452.823674"], [1305031452.791720, 1305031452.823674]),
        (["1548266469.5", "1548266470"], [1548266469.5, 1548266470.0]),
        (["1403636579", "1403636580"], [1403636579.0, 1403636580.0]),
        (["1403636579763", "1403636579813"], [1403636579.763, 1403636579.813]),
        (["1403636579763555584", "1403636579813555456"], [1403636579.763555584, 1403636579.813555456]),
        (["0000000010", "0000000011"], None),
        (["1", "2"], None),
        (["20240131120000", "20240131120001"], [1706702400.0, 1706702401.0]),
        (["PXL_20240131_120000250", "PXL_20240131_120001500"], [1706702400.25, 1706702401.5]),
        (["2024-01-31T12:00:00.5Z", "2024-01-31T12:01:00Z"], [1706702400.5, 1706702460.0]),
        (["Photo 2024-01-31 12.00.00", "Photo 2024-01-31 12.00.03"], [1706702400.0, 1706702403.0]),
        (["IMG_20240131_120000", "VID_20240131_120001"], None),  # of two clocks, perhaps
        (["IMG_20240231_120000", "IMG_20240231_120001"], None),  # no date
        (["IMG_20240131_120000", "IMG_20240131_120000_1"], None),  # a burst within a second
        (["-0.5", "0.25"], [-0.5, 0.25]),
        (["img0.5", "img1.0"], None),
        (["0.5", "0.5"], None),
        (["0.5", "0.25"], None),
        (["0.5", "img"], None),
        (["0.5"], None),
    ],
)
def test_moments_are_told_from_positions(names: list[str], seconds: list[float] | None) -> None:
    assert time_stamps(names) == seconds


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["img1", "img2", "img4"], ["number 3 is missing between img1 and img4"]),
        (["000", "005", "010", "020", "030"], ["numbers 15, 25 are missing between 000 and 030"]),
        ([f"{n}" for n in range(100) if not 20 <= n < 32], ["20, 21, 22, 23, 24, 25, 26, 27, 28, 29 and 2 more"]),
        (["frame-001.color", "frame-003.color", "frame-004.color"], ["number 2 is missing"]),
        (["a1", "a2", "b1", "b3", "b4"], ["number 2 is missing between b1 and b4"]),
        (["1", "17", "40", "41"], []),
        (["0", "5", "10"], []),
        (["0.1", "0.2", "0.4"], []),
        (["1403636579", "1403636580", "1403636582"], []),
        (["IMG_20240131_120000", "IMG_20240131_120001", "IMG_20240131_120003"], []),
        (["2024-01-31 12-00-05", "2024-01-31 12-00-06", "2024-01-31 12-00-08"], []),
        (["a", "b"], []),
    ],
)
def test_gaps_are_named(names: list[str], expected: list[str]) -> None:
    found = missing_numbers(names)
    assert len(found) == len(expected)
    assert all(part in line for part, line in zip(expected, found, strict=True))
