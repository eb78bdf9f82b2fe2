"""Frames that clips were drawn from, compared with those that are there: what changes no clip may change."""

import pytest

from logvggt_jax.data.feeding.frame_range import FrameRange, Range
from logvggt_jax.data.feeding.listed_frames import check_listed_frames, listed_frames
from logvggt_jax.errors import InputError


class Counted:
    """Sequences of which only the number of frames is known; None cannot be listed."""

    def __init__(self, **counts: int | None) -> None:
        self._counts, self.sequences = counts, tuple(counts)

    def num_frames(self, sequence: str) -> int:
        count = self._counts[sequence]
        if count is None:
            raise OSError(f"{sequence}: input/output error")
        return count


def listed(frames: Range | None = None, **counts: int | None) -> dict[str, dict[str, str | None]]:
    dataset = Counted(**counts)
    return listed_frames({"own": dataset if frames is None else FrameRange(dataset, frames, "own")})  # type: ignore[arg-type,dict-item]


@pytest.mark.parametrize(
    ("frames", "found"),
    [
        (None, "0:10 and has 0:12 now"),
        ((None, -4), "0:6 and has 0:8 now"),
        # As many as before, but others.
        ((-4, None), "6:10 and has 8:12 now"),
        ((None, 7), None),
    ],
)
def test_frames_that_are_others_are_named_and_the_same_ones_pass(frames: Range | None, found: str | None) -> None:
    before, after = (listed(frames, walk=count, stairs=5) for count in (10, 12))
    if found is None:
        check_listed_frames(before, after)
        return
    with pytest.raises(InputError, match=f"written: own, walk had frames {found}. The clips would be others"):
        check_listed_frames(before, after)


def test_sequences_that_came_or_went_are_named() -> None:
    with pytest.raises(InputError, match="own, walk is gone; own, stairs is new"):
        check_listed_frames(listed(walk=3), listed(stairs=3))
    many = {f"walk{number}": 3 for number in range(9)}
    with pytest.raises(InputError, match="own, walk4 is new; and 4 more"):
        check_listed_frames(listed(), listed(**many))


def test_what_cannot_be_listed_is_nobodys_change() -> None:
    for then, now in ((None, 3), (3, None)):
        check_listed_frames(listed(walk=then), listed(walk=now))
    check_listed_frames({}, listed(walk=3))
