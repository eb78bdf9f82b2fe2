"""A part of every sequence: frames are renumbered, and are the same frames."""

import numpy as np
import pytest

from logvggt_jax.data import open_dataset
from logvggt_jax.data.feeding.frame_range import FrameRange, shared_frames
from logvggt_jax.errors import InputError

OPTIONS = {"height": 28, "width": 42, "num_frames": 10, "num_rooms": 2}


@pytest.fixture(scope="module")
def rooms():
    return open_dataset("rooms", None, "train", **OPTIONS)


def test_the_last_frames_are_numbered_from_zero_and_are_the_same(rooms):
    last, name = FrameRange(rooms, (-4, None), "rooms"), rooms.sequences[0]
    assert last.sequences == rooms.sequences and last.num_frames(name) == 4
    assert list(last.frame_names(name)) == list(rooms.frame_names(name))[6:]
    assert last.image_size(name) == (28, 42) and last.identity != rooms.identity
    for found, expected in zip(last.read(name, [3, 0]), rooms.read(name, [9, 6]), strict=True):
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(IndexError, match=r"frames \(-4, None\): frame 4 does not exist"):
        last.read(name, [4])


@pytest.mark.parametrize(
    ("trained", "evaluated", "shared"),
    [((None, 6), (-4, None), False), ((None, 7), (-4, None), True), (None, (-4, None), True), ((0, 0), None, False)],
)
def test_ranges_that_share_frames_are_told_from_those_that_do_not(rooms, trained, evaluated, shared):
    views = [rooms if frames is None else FrameRange(rooms, frames, "rooms") for frames in (trained, evaluated)]
    assert shared_frames(*views, rooms.sequences[0]) is shared


def test_a_set_drawn_on_the_device_has_no_ranges():
    drawn = open_dataset("rooms", None, "train", renderer="device", **OPTIONS)
    with pytest.raises(InputError, match=r"rooms: drawn on the device.*leave frames out"):
        FrameRange(drawn.for_training(cache_dir=None, progress=False), (None, 5), "rooms")
