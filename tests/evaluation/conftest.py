"""Small rooms that all tests of evaluation share."""

import pytest
from known_answers import SIZE

from logvggt_jax.data.rooms.rooms import Rooms


@pytest.fixture(scope="session")
def rooms() -> Rooms:
    """Two rooms of 16 frames, 28 x 42 pixels."""
    return Rooms(split="test", height=SIZE[0], width=SIZE[1], num_frames=16, num_rooms=2)
