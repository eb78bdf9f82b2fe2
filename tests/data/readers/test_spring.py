"""Spring: a room written as stereo disparity comes back as depth; the grid, the sky and the numbering; damage."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from analytic_room import view
from room_video import CENTRE, FOCAL, INTRINSICS, SIZE, check_video, room_video, write_image

from logvggt_jax.data.formats.hdf5 import read_hdf5
from logvggt_jax.data.readers.spring import Spring

VIEWS = room_video(3)
# Four values of disparity for each pixel: pixel (u, v) of the picture is value (2u, 2v), so the finer grid's focal
# length and principal point are twice the picture's.
FINE = np.diag([2.0, 2.0, 1.0]) @ INTRINSICS


def write_disparity(path: Path, disparity: np.ndarray, name: str = "disparity") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=disparity, compression="gzip")


def disparity_of(pose: np.ndarray) -> np.ndarray:
    _, depth = view(pose, FINE, (2 * SIZE[0], 2 * SIZE[1]))
    return (FOCAL * 0.065 / depth).astype(np.float32)


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Sequence 0001 with frames 1 to 3 as the archives hold them."""
    folder = tmp_path / "train/0001"
    for number, each in enumerate(VIEWS, 1):
        write_image(folder / f"frame_left/frame_left_{number:04d}.png", each.image)
        write_disparity(folder / f"disp1_left/disp1_left_{number:04d}.dsp5", disparity_of(each.camera_to_world))
    (folder / "cam_data").mkdir()
    np.savetxt(folder / "cam_data/intrinsics.txt", [[FOCAL, FOCAL, *CENTRE]] * 3)
    np.savetxt(folder / "cam_data/extrinsics.txt", [each.extrinsics.ravel() for each in VIEWS])
    np.savetxt(folder / "cam_data/focaldistance.txt", [[1.0]] * 3)
    return folder


def test_the_room_comes_back(sequence: Path):
    film = Spring(sequence.parents[1])
    assert film.sequences == Spring(sequence.parents[1], "train").sequences == ("0001",)
    assert film.frame_names("0001") == ["frame_left_0001", "frame_left_0002", "frame_left_0003"]
    frames = film.read("0001", [0, 1, 2])
    assert frames.metric
    check_video(frames, VIEWS, depth_error=1e-5)


def test_depth_is_that_of_the_even_rows_and_columns(sequence: Path):
    disparity = np.full((96, 128), 0.5, np.float32)
    disparity[::2, ::2] = 2.0
    write_disparity(sequence / "disp1_left/disp1_left_0002.dsp5", disparity)
    depth = Spring(sequence.parents[1]).read("0001", [1]).depth
    np.testing.assert_allclose(depth, np.full((1, 48, 64), FOCAL * 0.065 / 2), rtol=1e-6)


def test_unknown_disparity_and_sky_become_zero(sequence: Path):
    disparity = np.full((96, 128), 1.0, np.float32)
    disparity[0, :12:2] = [np.nan, 0.0, -1.0, np.inf, -np.inf, 1e-42]
    write_disparity(sequence / "disp1_left/disp1_left_0001.dsp5", disparity)
    write_disparity(sequence / "disp1_left/disp1_left_0002.dsp5", np.zeros((96, 128), np.float16))
    frames = Spring(sequence.parents[1]).read("0001", [0, 1])
    assert not frames.depth[0, 0, :6].any()
    np.testing.assert_allclose(frames.depth[0, 0, 6:], FOCAL * 0.065, rtol=1e-6)
    assert not frames.depth[1].any()


def test_rows_belong_to_numbers_that_start_at_one(sequence: Path):
    np.savetxt(sequence / "cam_data/intrinsics.txt", [[60 + row, 70 + row, *CENTRE] for row in range(3)])
    for path in (sequence / "frame_left/frame_left_0001.png", sequence / "disp1_left/disp1_left_0001.dsp5"):
        path.unlink()
    film = Spring(sequence.parents[1])
    frames = film.read("0001", [0, 1])
    assert film.frame_names("0001") == ["frame_left_0002", "frame_left_0003"]
    assert frames.intrinsics[:, 0, 0].tolist() == [61, 62] and frames.intrinsics[:, 1, 1].tolist() == [71, 72]
    np.testing.assert_allclose(frames.extrinsics[0], VIEWS[1].extrinsics, atol=1e-6)
    # Depth follows the frame's own focal length.
    np.testing.assert_allclose(frames.depth[0], VIEWS[1].depth * 61 / FOCAL, rtol=1e-4)
    write_image(sequence / "frame_left/frame_left_0000.png", VIEWS[0].image)
    write_disparity(sequence / "disp1_left/disp1_left_0000.dsp5", np.ones((96, 128), np.float32))
    with pytest.raises(ValueError, match=r"frame_left_0000\.png: frames are numbered from 1"):
        Spring(sequence.parents[1]).num_frames("0001")


def test_frames_without_finite_cameras_are_dropped_and_counted(sequence: Path):
    poses = np.stack([each.extrinsics.ravel() for each in VIEWS])
    poses[0] = np.nan
    np.savetxt(sequence / "cam_data/extrinsics.txt", poses)
    np.savetxt(sequence / "cam_data/intrinsics.txt", [[FOCAL, FOCAL, *CENTRE]] * 2 + [[np.inf] * 4])
    film = Spring(sequence.parents[1])
    assert film.frame_names("0001") == ["frame_left_0002"]
    assert film.dropped_frames("0001") == {"no pose": 1, "no intrinsics": 1}


def test_the_test_half_is_not_offered(sequence: Path):
    sequence.parents[1].joinpath("test/0003").mkdir(parents=True)
    assert Spring(sequence.parents[1]).sequences == ("0001",)
    with pytest.raises(ValueError, match="Spring has no split 'test'"):
        Spring(sequence.parents[1], "test")
    sequence.parent.rename(sequence.parents[1] / "spring_train")
    with pytest.raises(FileNotFoundError, match="train: no such folder"):
        Spring(sequence.parents[1])


@pytest.mark.parametrize(
    "name",
    [
        "frame_left/frame_left_0002.png",
        "disp1_left/disp1_left_0002.dsp5",
        "cam_data/intrinsics.txt",
        "cam_data/extrinsics.txt",
    ],
)
def test_a_missing_file_is_named(sequence: Path, name: str):
    (sequence / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        Spring(sequence.parents[1]).num_frames("0001")


@pytest.mark.parametrize("name", ["intrinsics.txt", "extrinsics.txt"])
def test_damaged_tables_are_named(sequence: Path, name: str):
    path = sequence / "cam_data" / name
    lines = path.read_text().splitlines()
    for damaged, complaint in (
        (lines[:2], "a row for each of the frames 1 to 3, got 2 rows"),
        ([], "empty"),
        ([lines[0], lines[1] + " 1", lines[2]], "row 2: expected (4|16) numbers, got (5|17)"),
    ):
        path.write_text("\n".join(damaged))
        with pytest.raises(ValueError, match=rf"{name}.*{complaint}"):
            Spring(sequence.parents[1]).num_frames("0001")


def test_poses_that_are_not_rotations_are_named(sequence: Path):
    np.savetxt(sequence / "cam_data/extrinsics.txt", [np.eye(4).ravel(), 3 * np.eye(4).ravel(), np.eye(4).ravel()])
    with pytest.raises(ValueError, match=r"extrinsics\.txt, row 2: not a rigid transform"):
        Spring(sequence.parents[1]).num_frames("0001")


def test_damaged_disparity_is_named(sequence: Path):
    film, path = Spring(sequence.parents[1]), sequence / "disp1_left/disp1_left_0002.dsp5"
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:-100], b"", b"not HDF5"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"disp1_left_0002\.dsp5: truncated or damaged"):
            film.read("0001", [1])
    write_disparity(path, np.ones((48, 64), np.float32))
    with pytest.raises(ValueError, match=r"disp1_left_0002\.dsp5: expected numbers of shape 96 x 128.*\(48, 64\)"):
        film.read("0001", [1])
    write_disparity(path, np.ones((96, 128), np.float32), name="flow")
    with pytest.raises(ValueError, match=r"disp1_left_0002\.dsp5: no array 'disparity', only flow"):
        film.read("0001", [1])
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"disp1_left_0002\.dsp5"):
        film.read("0001", [1])


def test_other_types_and_a_missing_package_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "words.h5"
    write_disparity(path, np.array([[b"a"]]))
    with pytest.raises(ValueError, match=r"words\.h5: expected numbers of shape any x 1.*S1"):
        read_hdf5(path, "disparity", shape=(None, 1))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"logvggt-jax\[data\]"):
        read_hdf5(path, "disparity", shape=(None, 1))
