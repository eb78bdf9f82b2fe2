"""Baselines know what their row says, and no more."""

import numpy as np
import pytest

from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.evaluation.methods.baselines import depth_statistics


def test_depth_baselines_know_the_mean_of_what_they_were_given(rooms: Rooms) -> None:
    statistics = depth_statistics(rooms, (28, 42), source="these rooms", max_frames=6)
    depth = np.concatenate([rooms.read(name, [0, 8, 15]).depth for name in rooms.sequences])
    assert statistics.mean_depth == pytest.approx(depth.mean(), rel=1e-5)
    np.testing.assert_allclose(statistics.mean_map, depth.mean(0), rtol=1e-5)
