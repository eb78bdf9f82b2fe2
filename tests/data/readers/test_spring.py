"""Spring: disparity's finer grid, the sky, the numbering from one, rows of the cameras."""

import sys
from pathlib import Path

import numpy as np
import pytest
from analytic_room import view
from layouts.layout import VIEWS
from layouts.spring import BASELINE, LAYOUT, write_disparity
from room_views import CENTRE, FOCAL, INTRINSICS, SIZE, check_views, write_image

from logvggt_jax.data.formats.hdf5 import read_hdf5
from logvggt_jax.data.readers.spring import Spring

NUMBERS = range(1, 5)


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, VIEWS)
    return tmp_path / "train/0001"


def opened(sequence: Path, split: str = "all") -> Spring:
    return Spring(sequence.parents[1], split)


def test_the_room_seen_on_the_finer_grid_comes_back(sequence: Path):
    # Pixel (u, v) of the picture is value (2u, 2v), so the grid's focal length and principal point are twice as large.
    fine = np.diag([2.0, 2.0, 1.0]) @ INTRINSICS
    for number, each in zip(NUMBERS, VIEWS, strict=True):
        _, depth = view(each.pose, fine, (2 * SIZE[0], 2 * SIZE[1]))
        disparity = (FOCAL * BASELINE / depth).astype(np.float32)
        write_disparity(sequence / f"disp1_left/disp1_left_{number:04d}.dsp5", disparity)
    check_views(opened(sequence).read("0001", range(4)), VIEWS, picture_error=0, depth_error=1e-5)


def test_unknown_disparity_and_sky_become_zero(sequence: Path):
    disparity = np.full((96, 128), 1.0, np.float32)
    disparity[0, :12:2] = [np.nan, 0.0, -1.0, np.inf, -np.inf, 1e-42]
    write_disparity(sequence / "disp1_left/disp1_left_0001.dsp5", disparity)
    frames = opened(sequence).read("0001", [0])
    assert not frames.depth[0, 0, :6].any()
    np.testing.assert_allclose(frames.depth[0, 0, 6:], FOCAL * BASELINE, rtol=1e-6)


def test_rows_belong_to_numbers_that_start_at_one(sequence: Path):
    np.savetxt(sequence / "cam_data/intrinsics.txt", [[60 + row, 70 + row, *CENTRE] for row in range(4)])
    for path in (sequence / "frame_left/frame_left_0001.png", sequence / "disp1_left/disp1_left_0001.dsp5"):
        path.unlink()
    film = opened(sequence)
    frames = film.read("0001", [0, 1])
    assert film.frame_names("0001")[:2] == ["frame_left_0002", "frame_left_0003"]
    assert frames.intrinsics[:, 0, 0].tolist() == [61, 62] and frames.intrinsics[:, 1, 1].tolist() == [71, 72]
    np.testing.assert_allclose(frames.extrinsics[0], VIEWS[1].extrinsics, atol=1e-6)
    # Depth follows the frame's own focal length.
    np.testing.assert_allclose(frames.depth[0], VIEWS[1].depth * 61 / FOCAL, rtol=1e-4)
    write_image(sequence / "frame_left/frame_left_0000.png", VIEWS[0].picture)
    write_disparity(sequence / "disp1_left/disp1_left_0000.dsp5", np.ones((96, 128), np.float32))
    with pytest.raises(ValueError, match=r"frame_left_0000\.png: frames are numbered from 1"):
        opened(sequence).num_frames("0001")


def test_the_test_half_is_not_offered(sequence: Path):
    sequence.parents[1].joinpath("test/0003").mkdir(parents=True)
    assert opened(sequence).sequences == opened(sequence, "train").sequences == ("0001",)


def test_other_types_and_a_missing_package_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "words.h5"
    write_disparity(path, np.array([[b"a"]]))
    with pytest.raises(ValueError, match=r"words\.h5: expected numbers of shape any x 1.*S1"):
        read_hdf5(path, "disparity", shape=(None, 1))
    content = path.read_bytes()
    assert content.count(b"disparity") == 1
    path.write_bytes(content.replace(b"disparity", b"di\xffparity"))
    with pytest.raises(ValueError, match=r"words\.h5: no array 'disparity', only di�parity"):
        read_hdf5(path, "disparity", shape=(None, 1))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"logvggt-jax\[data\]"):
        read_hdf5(path, "disparity", shape=(None, 1))
