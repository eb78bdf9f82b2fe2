"""KITTI odometry: poses are carried to the colour camera; depth is there only where it was added."""

from pathlib import Path

import numpy as np
from layouts.kitti_odometry import DEPTH, LAYOUT, SHIFT, write
from layouts.layout import VIEWS
from room_views import check_views

from logvggt_jax.data.readers.kitti_odometry import KITTIOdometry


def test_without_depth_frames_count_and_have_none(tmp_path: Path):
    write(tmp_path, VIEWS, depth=False)
    frames = KITTIOdometry(tmp_path).read("00", range(4))
    assert not frames.depth.any()
    relative = frames.extrinsics[1] @ np.linalg.inv(frames.extrinsics[0])
    np.testing.assert_allclose(relative, VIEWS[1].extrinsics @ VIEWS[0].pose, atol=1e-5)


def test_poses_are_those_of_the_colour_camera(tmp_path: Path):
    write(tmp_path, VIEWS)
    of_camera_0 = np.loadtxt(tmp_path / "poses/00.txt").reshape(-1, 3, 4)
    extrinsics = KITTIOdometry(tmp_path).extrinsics("00").astype(np.float64)
    for stored, found in zip(of_camera_0, extrinsics, strict=True):
        # A point's coordinates differ by the shift between the cameras.
        point = np.array([1.0, 2.0, 3.0])
        in_camera_0 = stored[:, :3].T @ (point - stored[:, 3])
        np.testing.assert_allclose(found[:3, :3] @ point + found[:3, 3], in_camera_0 + SHIFT, atol=1e-5)


def test_pictures_without_depth_do_not_count_where_others_have_it(tmp_path: Path):
    write(tmp_path, VIEWS)
    (tmp_path / DEPTH).unlink()
    dataset = KITTIOdometry(tmp_path)
    assert dataset.frame_names("00") == ["000000", "000002", "000003"]
    assert dataset.dropped_frames("00") == {"no depth": 1}
    kept = [VIEWS[0], *VIEWS[2:]]
    check_views(dataset.read("00", range(3)), kept, picture_error=0, depth_error=LAYOUT.depth_error, overlap=0.3)


def test_sequences_whose_poses_are_not_published_are_left_out(tmp_path: Path):
    for name in ("00", "10"):
        write(tmp_path, VIEWS, name=name, depth=False)
    (tmp_path / "sequences/11/image_2").mkdir(parents=True)
    assert KITTIOdometry(tmp_path, "train").sequences == KITTIOdometry(tmp_path).sequences == ("00", "10")
