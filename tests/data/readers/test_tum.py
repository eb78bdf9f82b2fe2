"""TUM RGB-D: three clocks, quaternions x y z w, three cameras, the prepared form."""

from pathlib import Path

import numpy as np
import pytest
from analytic_room import pinhole
from layouts.timed import (
    DEPTHS,
    NAMES,
    PICTURES,
    STEP,
    trajectory_line,
    write_list,
    write_pictures,
    write_sequence,
    write_trajectory,
)
from layouts.timed import TUM_NAME as NAME
from layouts.timed import TUM_VIEWS as VIEWS
from room_views import SIZE, check_views, room_views

from logvggt_jax.data.readers.tum import TUM

ERRORS = {"picture_error": 0, "depth_error": 0.51 * STEP}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path / NAME, VIEWS)
    (tmp_path / f"{NAME}.tgz").touch()
    (tmp_path / "rgbd_dataset_freiburg3_empty").mkdir()
    return tmp_path


def test_each_camera_has_its_intrinsics(tmp_path: Path):
    cameras = {
        "rgbd_dataset_freiburg1_desk": (51.73, 51.65, 31.41, 25.08),
        "rgbd_dataset_freiburg2_xyz": (52.09, 52.1, 32.06, 24.52),
    }
    for name, (fx, fy, cx, cy) in cameras.items():
        matrix = pinhole(SIZE, fx, (cx, cy))
        matrix[1, 1] = fy
        views = room_views(5, matrix)
        write_sequence(tmp_path / name, views)
        check_views(TUM(tmp_path).read(name, range(5)), views, **ERRORS)


def test_order_is_by_time_not_by_line(root: Path):
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        path = root / NAME / name
        path.write_text("\n".join(reversed(path.read_text().splitlines())))
    tum = TUM(root)
    assert tum.frame_names(NAME) == NAMES
    check_views(tum.read(NAME, range(5)), VIEWS, **ERRORS)


def test_pictures_without_depth_or_pose_in_time_are_dropped_and_the_rest_keeps_its_partners(root: Path):
    write_list(root / NAME / "depth.txt", "depth", np.delete(DEPTHS, 1))
    lines = [trajectory_line(time + 0.005, VIEWS[i].pose) for i, time in enumerate(PICTURES) if i != 3]
    (root / NAME / "groundtruth.txt").write_text("\n".join(lines))
    tum = TUM(root)
    assert tum.frame_names(NAME) == [NAMES[0], NAMES[2], NAMES[4]]
    assert tum.dropped_frames(NAME) == {"no depth": 1, "no pose": 1}
    check_views(tum.read(NAME, range(3)), VIEWS[::2], overlap=0.2, **ERRORS)


def test_the_prepared_form_comes_back_with_and_without_depth(tmp_path: Path):
    folder = tmp_path / NAME
    write_pictures(folder / "rgb_90", folder / "depth_90", VIEWS)
    write_trajectory(folder / "groundtruth_90.txt", VIEWS, PICTURES + 0.004)
    name = f"{NAME}/rgb_90"
    tum = TUM(tmp_path)
    assert tum.sequences == (name,) and tum.frame_names(name) == NAMES
    check_views(tum.read(name, range(5)), VIEWS, **ERRORS)
    for path in (folder / "depth_90").iterdir():
        path.unlink()
    (folder / "depth_90").rmdir()
    for _ in range(2):  # listed, then from the index
        frames = TUM(tmp_path).read(name, [0, 3])
        assert not frames.depth.any() and frames.depth.shape == frames.images.shape[:3]
        np.testing.assert_allclose(frames.extrinsics[1], VIEWS[3].extrinsics, atol=1e-6)


def test_prepared_poses_must_be_those_of_the_pictures(tmp_path: Path):
    folder = tmp_path / NAME
    write_pictures(folder / "rgb_90", folder / "depth_90", VIEWS)
    write_trajectory(folder / "groundtruth_90.txt", VIEWS, PICTURES[:4])
    with pytest.raises(ValueError, match=rf"groundtruth_90\.txt.*got none for {NAMES[4]}\.png"):
        TUM(tmp_path).num_frames(f"{NAME}/rgb_90")
    write_trajectory(folder / "groundtruth_90.txt", VIEWS, PICTURES)
    (folder / f"depth_90/{DEPTHS[0]:.6f}.png").unlink()
    with pytest.raises(ValueError, match=r"depth_90: expected 5 files.*got 4"):
        TUM(tmp_path).num_frames(f"{NAME}/rgb_90")


def test_the_full_sequence_goes_before_what_was_prepared_from_it(root: Path):
    (root / NAME / "rgb_90").mkdir()
    assert TUM(root).sequences == (NAME,)
