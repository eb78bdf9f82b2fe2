"""MPI Sintel: sky becomes 0; sizes and tags of the binary files are checked."""

from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.sintel import LAYOUT, write_depth

from logvggt_jax.data.readers.sintel import Sintel


@pytest.fixture
def training(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, VIEWS)
    return tmp_path / "training"


def test_both_splits_are_the_training_half(training: Path):
    assert Sintel(training.parent, "train").sequences == Sintel(training.parent).sequences == ("alley_2",)


def test_sky_and_other_invalid_depth_become_zero(training: Path):
    depth = np.full(VIEWS[0].depth.shape, 500.0)
    depth[0, :7] = [1e11, 1000.5, np.inf, np.nan, 0.0, -1.0, 1000.0]
    write_depth(training / "depth/alley_2/frame_0002.dpt", depth)
    read = Sintel(training.parent).read("alley_2", [1]).depth[0]
    np.testing.assert_array_equal(read[0, :8], np.float32([0, 0, 0, 0, 0, 0, 1000, 500]))
