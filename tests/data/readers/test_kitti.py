"""KITTI depth: sparse depth, no poses, both layouts; frames start where depth does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_sequence import room_frame

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.readers.kitti import KITTI

SIZE = (36, 124)
INTRINSICS = pinhole(SIZE, 72.15377, (60.95593, 17.2854))
DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0002_sync"
NUMBERS = (5, 6, 7, 8)
GATHERED = Path("depth_selection/val_selection_cropped")


def calibration() -> str:
    def line(name: str, matrix: np.ndarray) -> str:
        return f"{name}: " + " ".join(f"{value:.6e}" for value in matrix.ravel())

    projection = np.hstack([INTRINSICS, [[4.485728], [0.2163791], [0.002745884]]])
    other = projection * [[2.0], [2.0], [1.0]]
    return "\n".join(
        [
            "calib_time: 09-Jan-2012 13:57:47",
            line("K_02", pinhole(SIZE, 95.0)),
            line("P_rect_00", other),
            line("P_rect_02", projection),
            line("P_rect_03", other),
        ]
    )


def sparse(index: int) -> np.ndarray:
    """The room's depth as uint16 / 256 where the laser went."""
    depth = np.rint(room_frame(index, INTRINSICS, SIZE).depth * 256).astype(np.uint16)
    measured = np.random.default_rng(index).random(SIZE) < 0.2
    return np.where(measured, depth, 0).astype(np.uint16)


def write(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture)


def write_frames(images: Path, depths: Path) -> None:
    for index in NUMBERS:
        write(images / f"{index:010d}.png", room_frame(index, INTRINSICS, SIZE).picture[..., ::-1])
        write(depths / f"{index:010d}.png", sparse(index))


def write_calibration(root: Path, date: str = DATE) -> None:
    (root / date).mkdir(exist_ok=True)
    (root / date / "calib_cam_to_cam.txt").write_text(calibration())


def write_drive(root: Path, drive: str = DRIVE, part: str = "val") -> None:
    date = drive[:10]
    images = root / date / drive / "image_02" / "data"
    write_frames(images, root / part / drive / "proj_depth" / "groundtruth" / "image_02")
    for index in (0, 1, 9):  # pictures outside the range of depth
        write(images / f"{index:010d}.png", np.zeros((*SIZE, 3), np.uint8))
    write_calibration(root, date)


def assert_comes_back(kitti: KITTI, sequence: str) -> None:
    assert kitti.frame_names(sequence) == [f"{index:010d}" for index in NUMBERS]
    frames = kitti.read(sequence, [3, 0])
    check_frames(frames, sequence, poses=False)
    assert np.isnan(frames.extrinsics).all() and frames.metric
    for position, index in enumerate((8, 5)):
        frame = room_frame(index, INTRINSICS, SIZE)
        np.testing.assert_array_equal(frames.images[position], frame.picture)
        np.testing.assert_allclose(frames.intrinsics[position], INTRINSICS, rtol=1e-6)
        measured = sparse(index) > 0
        np.testing.assert_array_equal(frames.depth[position] > 0, measured)
        np.testing.assert_allclose(frames.depth[position][measured], frame.depth[measured], atol=0.501 / 256)
    depth = frames.depth.astype(np.float64)
    v, u = np.nonzero(depth[0])
    points = np.linalg.inv(frames.intrinsics[0].astype(np.float64)) @ np.stack([u, v, np.ones(len(u))]) * depth[0][v, u]
    pose = room_frame(8, INTRINSICS, SIZE).pose
    world = pose[:3, :3] @ points + pose[:3, 3:]
    # Depth and calibration together put the points on the room's walls.
    assert np.abs(np.abs(world) / np.array([[2.5], [1.4], [3.0]])).max(0).max() < 1.002
    assert np.abs(np.abs(world) / np.array([[2.5], [1.4], [3.0]])).max(0).min() > 0.998


def test_a_written_drive_comes_back(tmp_path: Path):
    write_drive(tmp_path)
    kitti = KITTI(tmp_path)
    assert kitti.sequences == (DRIVE,)
    assert kitti.num_frames(DRIVE) == 4 and kitti.dropped_frames(DRIVE) == {"no depth": 3}
    assert_comes_back(kitti, DRIVE)


@pytest.mark.parametrize("suffix", ["", "_50"])
def test_the_gathered_form_comes_back(tmp_path: Path, suffix: str):
    folder = f"{DRIVE}_02"
    write_frames(
        tmp_path / GATHERED / f"image_gathered{suffix}" / folder,
        tmp_path / GATHERED / f"groundtruth_depth_gathered{suffix}" / folder,
    )
    write_calibration(tmp_path)
    kitti = KITTI(tmp_path, "val")
    name = f"{DRIVE}/image_gathered{suffix}"
    assert kitti.sequences == (name,)
    assert_comes_back(kitti, name)
    with pytest.raises(FileNotFoundError, match="no sequences of KITTI depth"):
        KITTI(tmp_path, "train")
    # Annotations without raw pictures do not hide it, a whole drive does.
    write_drive(tmp_path / "whole")
    (tmp_path / "whole/val").rename(tmp_path / "val")
    assert KITTI(tmp_path).sequences == (name,)
    (tmp_path / f"whole/{DATE}/{DRIVE}").rename(tmp_path / DATE / DRIVE)
    assert KITTI(tmp_path).sequences == (DRIVE,)


def test_splits_are_the_folders(tmp_path: Path):
    other = "2011_09_28_drive_0001_sync"
    write_drive(tmp_path)
    write_drive(tmp_path, other, "train")
    assert KITTI(tmp_path).sequences == (DRIVE, other)
    assert KITTI(tmp_path, "val").sequences == (DRIVE,)
    assert KITTI(tmp_path, "train").sequences == (other,)
    with pytest.raises(ValueError, match="KITTI depth has no split 'test'"):
        KITTI(tmp_path, "test")


def test_frames_without_any_return_are_kept(tmp_path: Path):
    write_drive(tmp_path)
    write(tmp_path / f"val/{DRIVE}/proj_depth/groundtruth/image_02/0000000006.png", np.zeros(SIZE, np.uint16))
    kitti = KITTI(tmp_path)
    assert kitti.num_frames(DRIVE) == 4
    assert not kitti.read(DRIVE, [1]).depth.any()


def test_missing_files_are_named(tmp_path: Path):
    write_drive(tmp_path)
    images = tmp_path / DATE / DRIVE / "image_02/data"
    (images / "0000000006.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"data/0000000006\.png: no such file"):
        KITTI(tmp_path).num_frames(DRIVE)
    images.rename(images.with_name("elsewhere"))
    with pytest.raises(FileNotFoundError, match="image_02/data: no such folder"):
        KITTI(tmp_path).num_frames(DRIVE)
    (tmp_path / DATE / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"calib_cam_to_cam\.txt: no such file.*2011_09_26_calib\.zip"):
        KITTI(tmp_path).num_frames(DRIVE)
    with pytest.raises(FileNotFoundError, match="no sequences of KITTI depth"):
        KITTI(tmp_path, "train")


def test_gathered_pictures_and_depth_of_unequal_count_are_named(tmp_path: Path):
    folder = f"{DRIVE}_02"
    depths = tmp_path / GATHERED / "groundtruth_depth_gathered" / folder
    write_frames(tmp_path / GATHERED / "image_gathered" / folder, depths)
    write_calibration(tmp_path)
    (depths / "0000000007.png").unlink()
    with pytest.raises(FileNotFoundError, match=rf"groundtruth_depth_gathered/{folder}/0000000007\.png: no such file"):
        KITTI(tmp_path).num_frames(f"{DRIVE}/image_gathered")


def test_damaged_files_are_named(tmp_path: Path):
    write_drive(tmp_path)
    path = tmp_path / f"val/{DRIVE}/proj_depth/groundtruth/image_02/0000000006.png"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"image_02/0000000006\.png: truncated"):
        KITTI(tmp_path).read(DRIVE, [1])
    write(path, np.zeros(SIZE, np.uint8))
    with pytest.raises(ValueError, match=r"image_02/0000000006\.png: expected 16-bit depth"):
        KITTI(tmp_path).read(DRIVE, [1])
    calibration_file = tmp_path / DATE / "calib_cam_to_cam.txt"
    calibration_file.write_text("P_rect_02: 1 2 3\n")
    with pytest.raises(ValueError, match=r"calib_cam_to_cam\.txt, P_rect_02: expected 12 numbers, got 3"):
        KITTI(tmp_path).num_frames(DRIVE)
    calibration_file.write_text("P_rect_00: 1 2 3\n")
    with pytest.raises(ValueError, match=r"calib_cam_to_cam\.txt: no line P_rect_02"):
        KITTI(tmp_path).num_frames(DRIVE)
