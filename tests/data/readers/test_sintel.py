"""MPI Sintel: sky becomes 0; sizes and tags of the binary files are checked."""

import struct
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.sintel import LAYOUT, TAG, write_camera, write_depth
from room_views import INTRINSICS

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


def test_frames_without_finite_intrinsics_are_dropped_and_counted(training: Path):
    write_camera(training / "camdata_left/alley_2/frame_0003.cam", np.eye(4), np.full((3, 3), np.nan))
    assert Sintel(training.parent).dropped_frames("alley_2") == {"no intrinsics": 1}


def test_archives_that_are_not_there_are_named(training: Path):
    (training / "final").rename(training / "albedo")
    with pytest.raises(FileNotFoundError, match="training/final: no such folder"):
        Sintel(training.parent)


def test_damaged_depth_is_named(training: Path):
    film, path = Sintel(training.parent), training / "depth/alley_2/frame_0002.dpt"
    whole = path.read_bytes()
    assert len(whole) == 12 + 4 * 48 * 64
    for damaged, complaint in (
        (whole[:-1], "expected 12300 bytes for 64 x 48 pixels, got 12299"),
        (whole + b"\0", "expected 12300 bytes"),
        (whole[:10], "for 64 x 48|for 64 x 0|bytes for"),
        (TAG + struct.pack("<ii", -1, -3072) + whole[12:], "bytes for -1 x -3072 pixels"),
        (whole[:4][::-1] + whole[4:], r"tag 202021\.25"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"frame_0002\.dpt.*({complaint})"):
            film.read("alley_2", [1])


def test_damaged_cameras_are_named(training: Path):
    path = training / "camdata_left/alley_2/frame_0002.cam"
    whole = path.read_bytes()
    for damaged, complaint in ((whole[:-8], "expected 172 bytes, got 164"), (b"PIEX" + whole[4:], r"tag 202021\.25")):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"frame_0002\.cam.*{complaint}"):
            Sintel(training.parent).num_frames("alley_2")
    write_camera(path, np.eye(4), INTRINSICS.T)
    with pytest.raises(ValueError, match=r"frame_0002\.png: intrinsics"):
        Sintel(training.parent).read("alley_2", [1])
