"""MPI Sintel: a room written byte by byte comes back; sky becomes 0; damage is named."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from room_video import INTRINSICS, check_video, room_video, write_image

from logvggt_jax.data.readers.sintel import Sintel

TAG = struct.pack("<f", 202021.25)
VIEWS = room_video(3)


def write_depth(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = depth.shape
    path.write_bytes(TAG + struct.pack("<ii", width, height) + struct.pack(f"<{depth.size}f", *depth.ravel()))


def write_camera(path: Path, extrinsics: np.ndarray, intrinsics: np.ndarray = INTRINSICS) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(TAG + struct.pack("<9d", *intrinsics.ravel()) + struct.pack("<12d", *extrinsics[:3].ravel()))


@pytest.fixture
def training(tmp_path: Path) -> Path:
    """Sequences alley_2 (frames 1 to 3) and market_5 (frame 1), and the pass that is not read."""
    folder = tmp_path / "training"
    for sequence, views in (("alley_2", VIEWS), ("market_5", VIEWS[:1])):
        for number, each in enumerate(views, 1):
            write_image(folder / f"final/{sequence}/frame_{number:04d}.png", each.image)
            write_image(folder / f"clean/{sequence}/frame_{number:04d}.png", 255 - each.image)
            write_depth(folder / f"depth/{sequence}/frame_{number:04d}.dpt", each.depth)
            write_camera(folder / f"camdata_left/{sequence}/frame_{number:04d}.cam", each.extrinsics)
    return folder


def test_the_room_comes_back(training: Path):
    film = Sintel(training.parent)
    assert film.sequences == ("alley_2", "market_5")
    assert film.frame_names("alley_2") == ["frame_0001", "frame_0002", "frame_0003"]
    frames = film.read("alley_2", [0, 1, 2])
    assert frames.metric
    check_video(frames, VIEWS, depth_error=1e-6)
    assert Sintel(training.parent, "train").sequences == film.sequences


def test_sky_and_other_invalid_depth_become_zero(training: Path):
    depth = np.full(VIEWS[0].depth.shape, 500.0)
    depth[0, :7] = [1e11, 1000.5, np.inf, np.nan, 0.0, -1.0, 1000.0]
    write_depth(training / "depth/alley_2/frame_0002.dpt", depth)
    read = Sintel(training.parent).read("alley_2", [1]).depth[0]
    np.testing.assert_array_equal(read[0, :8], np.float32([0, 0, 0, 0, 0, 0, 1000, 500]))
    write_depth(training / "depth/alley_2/frame_0003.dpt", np.full(depth.shape, 1e11))
    assert not Sintel(training.parent).read("alley_2", [2]).depth.any()


def test_frames_without_finite_cameras_are_dropped_and_counted(training: Path):
    write_camera(training / "camdata_left/alley_2/frame_0001.cam", np.full((4, 4), -np.inf))
    write_camera(training / "camdata_left/alley_2/frame_0003.cam", np.eye(4), np.full((3, 3), np.nan))
    film = Sintel(training.parent)
    assert film.frame_names("alley_2") == ["frame_0002"]
    assert film.dropped_frames("alley_2") == {"no pose": 1, "no intrinsics": 1}


def test_splits_and_archives_that_are_not_there_are_named(training: Path):
    with pytest.raises(ValueError, match="MPI Sintel has no split 'test'"):
        Sintel(training.parent, "test")
    (training / "final").rename(training / "albedo")
    with pytest.raises(FileNotFoundError, match="training/final: no such folder"):
        Sintel(training.parent)


@pytest.mark.parametrize("name", ["final/alley_2/frame_0002.png", "depth/alley_2/frame_0002.dpt"])
def test_a_missing_file_is_named(training: Path, name: str):
    film = Sintel(training.parent)
    assert film.num_frames("alley_2") == 3
    (training / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        film.read("alley_2", [1])
    with pytest.raises(FileNotFoundError, match=name):
        Sintel(training.parent).num_frames("alley_2")


def test_a_missing_camera_is_named(training: Path):
    (training / "camdata_left/alley_2/frame_0002.cam").unlink()
    with pytest.raises(FileNotFoundError, match=r"camdata_left/alley_2/frame_0002\.cam"):
        Sintel(training.parent).num_frames("alley_2")


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
        (b"", r"tag 202021\.25"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"frame_0002\.dpt.*({complaint})"):
            film.read("alley_2", [1])
    write_depth(path, np.ones((64, 48)))
    with pytest.raises(ValueError, match=r"frame_0002\.dpt: size \(64, 48\)"):
        film.read("alley_2", [1])


def test_damaged_cameras_are_named(training: Path):
    path = training / "camdata_left/alley_2/frame_0002.cam"
    whole = path.read_bytes()
    for damaged, complaint in ((whole[:-8], "expected 172 bytes, got 164"), (b"PIEX" + whole[4:], r"tag 202021\.25")):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"frame_0002\.cam.*{complaint}"):
            Sintel(training.parent).num_frames("alley_2")
    write_camera(path, 2 * np.eye(4))
    with pytest.raises(ValueError, match=r"frame_0002\.cam: not a rigid transform"):
        Sintel(training.parent).num_frames("alley_2")
    write_camera(path, np.eye(4), INTRINSICS.T)
    with pytest.raises(ValueError, match=r"frame_0002\.png: intrinsics"):
        Sintel(training.parent).read("alley_2", [1])
