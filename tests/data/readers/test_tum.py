"""TUM RGB-D: three clocks, quaternions x y z w, three cameras; a written sequence of known geometry comes back."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import camera_to_world, pinhole
from room_sequence import assert_shows_room
from timed_sequence import (
    DEPTHS,
    PICTURES,
    SIZE,
    STEP,
    trajectory_line,
    write_list,
    write_pictures,
    write_sequence,
    write_trajectory,
)

from logvggt_jax.data.readers.tum import TUM

NAME = "rgbd_dataset_freiburg3_walking_xyz"
# A tenth of 640 x 480: c' = (c + 0.5) / 10 - 0.5.
INTRINSICS = np.array([[53.54, 0, 31.56], [0, 53.92, 24.31], [0, 0, 1]])
NAMES = [f"{time:.6f}" for time in PICTURES]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path / NAME, INTRINSICS)
    return tmp_path


def test_a_written_sequence_comes_back(root: Path):
    (root / "rgbd_dataset_freiburg3_walking_xyz.tgz").touch()
    (root / "rgbd_dataset_freiburg3_empty").mkdir()
    tum = TUM(root)
    assert tum.sequences == (NAME,) and tum.metric
    assert tum.frame_names(NAME) == NAMES and tum.dropped_frames(NAME) == {}
    order = [3, 0, 1, 2]
    assert_shows_room(tum.read(NAME, order), order, INTRINSICS, depth_step=STEP)


def test_each_camera_has_its_intrinsics(tmp_path: Path):
    cameras = {
        "rgbd_dataset_freiburg1_desk": (51.73, 51.65, 31.41, 25.08),
        "rgbd_dataset_freiburg2_xyz": (52.09, 52.1, 32.06, 24.52),
    }
    for name, (fx, fy, cx, cy) in cameras.items():
        matrix = pinhole(SIZE, fx, (cx, cy))
        matrix[1, 1] = fy
        write_sequence(tmp_path / name, matrix)
        assert_shows_room(TUM(tmp_path).read(name, [0, 1, 2]), [0, 1, 2], matrix, depth_step=STEP)


def test_order_is_by_time_not_by_line(root: Path):
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        path = root / NAME / name
        path.write_text("\n".join(reversed(path.read_text().splitlines())))
    tum = TUM(root)
    assert tum.frame_names(NAME) == NAMES
    assert_shows_room(tum.read(NAME, [0, 1, 2, 3]), [0, 1, 2, 3], INTRINSICS, depth_step=STEP)


def test_pictures_without_depth_or_pose_in_time_are_dropped_and_the_rest_keeps_its_partners(root: Path):
    write_list(root / NAME / "depth.txt", "depth", np.delete(DEPTHS, 1))
    lines = [trajectory_line(time + 0.005, camera_to_world(i)) for i, time in enumerate(PICTURES) if i != 3]
    (root / NAME / "groundtruth.txt").write_text("\n".join(lines))
    tum = TUM(root)
    assert tum.frame_names(NAME) == [NAMES[0], NAMES[2], NAMES[4]]
    assert tum.dropped_frames(NAME) == {"no depth": 1, "no pose": 1}
    assert_shows_room(tum.read(NAME, [0, 1, 2]), [0, 2, 4], INTRINSICS, depth_step=STEP)


def test_poses_that_are_not_finite_are_lost(root: Path):
    lines = [trajectory_line(time, camera_to_world(i)) for i, time in enumerate(PICTURES)]
    lines[2] = " ".join([lines[2].split()[0], *["nan"] * 7])
    (root / NAME / "groundtruth.txt").write_text("\n".join(lines))
    assert TUM(root).dropped_frames(NAME) == {"no pose": 1}


def test_zero_depth_is_invalid(root: Path):
    depth = np.full(SIZE, 5000, np.uint16)
    depth[0, :2] = [0, 65535]
    cv2.imwrite(str(root / NAME / f"depth/{DEPTHS[0]:.6f}.png"), depth)
    read = TUM(root).read(NAME, [0]).depth[0]
    np.testing.assert_array_equal(read[0, :3], np.float32([0, 65535 / 5000, 1]))


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_there_are_no_splits(root: Path, split: str):
    with pytest.raises(ValueError, match=f"TUM RGB-D has no split '{split}'"):
        TUM(root, split)


def test_the_prepared_form_comes_back_with_and_without_depth(tmp_path: Path):
    folder = tmp_path / NAME
    write_pictures(folder / "rgb_90", folder / "depth_90", INTRINSICS)
    write_trajectory(folder / "groundtruth_90.txt", PICTURES + 0.004)
    name = f"{NAME}/rgb_90"
    tum = TUM(tmp_path)
    assert tum.sequences == (name,) and tum.frame_names(name) == NAMES
    assert_shows_room(tum.read(name, [0, 1, 2, 3]), [0, 1, 2, 3], INTRINSICS, depth_step=STEP)
    for path in (folder / "depth_90").iterdir():
        path.unlink()
    (folder / "depth_90").rmdir()
    for _ in range(2):  # listed, then from the index
        frames = TUM(tmp_path).read(name, [0, 3])
        assert not frames.depth.any() and frames.depth.shape == frames.images.shape[:3]
        np.testing.assert_allclose(frames.extrinsics[1], np.linalg.inv(camera_to_world(3)), atol=1e-6)


def test_prepared_poses_must_be_those_of_the_pictures(tmp_path: Path):
    folder = tmp_path / NAME
    write_pictures(folder / "rgb_90", folder / "depth_90", INTRINSICS)
    write_trajectory(folder / "groundtruth_90.txt", PICTURES[:4])
    with pytest.raises(ValueError, match=rf"groundtruth_90\.txt.*got none for {NAMES[4]}\.png"):
        TUM(tmp_path).num_frames(f"{NAME}/rgb_90")
    write_trajectory(folder / "groundtruth_90.txt", PICTURES)
    (folder / f"depth_90/{DEPTHS[0]:.6f}.png").unlink()
    with pytest.raises(ValueError, match=r"depth_90: expected 5 files.*got 4"):
        TUM(tmp_path).num_frames(f"{NAME}/rgb_90")


def test_the_full_sequence_goes_before_what_was_prepared_from_it(root: Path):
    (root / NAME / "rgb_90").mkdir()
    assert TUM(root).sequences == (NAME,)


@pytest.mark.parametrize("kind", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_a_missing_or_empty_list_is_named(root: Path, kind: str):
    (root / NAME / kind).write_text("# nothing\n")
    with pytest.raises(ValueError, match=rf"{kind}: expected lines"):
        TUM(root).num_frames(NAME)
    (root / NAME / kind).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{kind}: no such file"):
        TUM(root).num_frames(NAME)


def test_a_listed_file_that_is_missing_is_named(root: Path):
    (root / NAME / f"rgb/{NAMES[2]}.png").unlink()
    with pytest.raises(FileNotFoundError, match=rf"rgb/{NAMES[2]}\.png: no such file, but rgb\.txt lists it"):
        TUM(root).num_frames(NAME)


@pytest.mark.parametrize(
    ("kind", "line", "complaint"),
    [
        ("rgb.txt", "1305031102.0", "rgb.txt, line 7: expected 'time file'"),
        ("rgb.txt", "noon rgb/a.png", "rgb.txt, line 7: expected numbers"),
        ("rgb.txt", f"1 rgb/{NAMES[0]}.png", "rgb.txt, line 7: .* is listed twice"),
        ("groundtruth.txt", "1305031102.0 1 2 3", "groundtruth.txt, line 43: expected 8 numbers, got 4"),
    ],
)
def test_a_damaged_line_is_named(root: Path, kind: str, line: str, complaint: str):
    with (root / NAME / kind).open("a") as file:
        file.write(line + "\n")
    with pytest.raises(ValueError, match=complaint):
        TUM(root).num_frames(NAME)


def test_a_quaternion_that_is_none_is_named(root: Path):
    (root / NAME / "groundtruth.txt").write_text(f"\n{PICTURES[0]} 0 0 0 0 0 0 0\n")
    with pytest.raises(ValueError, match=r"groundtruth\.txt, line 2: expected a unit quaternion"):
        TUM(root).num_frames(NAME)


def test_depth_of_another_size_is_named(root: Path):
    path = root / NAME / f"depth/{DEPTHS[1]:.6f}.png"
    cv2.imwrite(str(path), np.zeros((24, 32), np.uint16))
    with pytest.raises(ValueError, match=rf"{path.name}: size \(24, 32\) differs from \(48, 64\)"):
        TUM(root).read(NAME, [0, 1])
