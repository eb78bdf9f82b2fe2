"""ARKitScenes: the room comes back whichever way up the tablet was held; times, splits and damage."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from layouts.arkitscenes import (
    INTRINSICS,
    NAME,
    PICTURE_TIMES,
    SIZE,
    VIDEO,
    roll,
    seen_from,
    sensor_path,
    stored_views,
    write_video,
)
from room_views import RoomView, check_views

from logvggt_jax.data.readers.arkitscenes import ARKitScenes


def written(root: Path, degrees: float = 0.0, name: str = NAME) -> list[RoomView]:
    """Writes a video; returns what it shows in the stored orientation."""
    path = sensor_path(degrees)
    views = stored_views(path)
    write_video(root, path, views, PICTURE_TIMES, name)
    return views


@pytest.fixture
def root(tmp_path: Path) -> Path:
    written(tmp_path)
    return tmp_path


@pytest.fixture
def video(root: Path) -> Path:
    return root / VIDEO


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, -90.0])
def test_the_room_comes_back_as_stored(tmp_path: Path, degrees: float):
    views, dataset = written(tmp_path, degrees), ARKitScenes(tmp_path, upright=False)
    frames = dataset.read(NAME, range(4))
    check_views(frames, views, picture_error=0, depth_error=1e-6)
    assert dataset.frame_names(NAME) == [f"41048190_{time:.3f}" for time in PICTURE_TIMES]


def test_the_form_for_object_detection_comes_back_where_the_raw_one_is_absent(tmp_path: Path):
    views = written(tmp_path)
    video = tmp_path / VIDEO
    frames_folder = tmp_path / f"3dod/{NAME}" / f"{video.name}_frames"
    shutil.copytree(video, frames_folder)
    for suffix in ("", "_intrinsics"):
        (frames_folder / f"vga_wide{suffix}").rename(frames_folder / f"lowres_wide{suffix}")
    assert ARKitScenes(tmp_path, "train").sequences == (NAME,)
    shutil.rmtree(video)
    dataset = ARKitScenes(tmp_path, "train", upright=False)
    assert dataset.sequences == (f"3dod/{NAME}",)
    check_views(dataset.read(f"3dod/{NAME}", range(4)), views, picture_error=0, depth_error=1e-6)
    with pytest.raises(FileNotFoundError):
        ARKitScenes(tmp_path, "val")


H, W = SIZE
FX, FY, CX, CY = INTRINSICS[0, 0], INTRINSICS[1, 1], INTRINSICS[0, 2], INTRINSICS[1, 2]


@pytest.mark.parametrize(
    ("held", "turns", "intrinsics"),
    [
        (0.0, 0, [FX, FY, CX, CY]),
        (20.0, 0, [FX, FY, CX, CY]),
        # The sky is on the stored picture's left: turned clockwise.
        (90.0, 3, [FY, FX, H - 1 - CY, CX]),
        (180.0, 2, [FX, FY, W - 1 - CX, H - 1 - CY]),
        (-90.0, 1, [FY, FX, CY, W - 1 - CX]),
        (-70.0, 1, [FY, FX, CY, W - 1 - CX]),
    ],
)
def test_the_room_comes_back_upright(tmp_path: Path, held: float, turns: int, intrinsics: list[float]):
    """`held`: how far the tablet is rolled clockwise about its axis, so that the picture's content is turned the
    other way."""
    stored = written(tmp_path, held)
    fx, fy, cx, cy = intrinsics
    expected = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    upright = []
    for seen in stored:
        # The camera turned back, its picture taken anew: independent of how pictures are turned.
        pose = seen.pose @ roll({0: 0, 1: 90, 2: 180, 3: -90}[turns])
        picture, _ = seen_from(pose, expected, SIZE if turns % 2 == 0 else SIZE[::-1])
        upright.append(RoomView(pose, expected, picture, np.rot90(seen.depth, turns)))
    frames = ARKitScenes(tmp_path).read(NAME, range(4))
    check_views(frames, upright, picture_error=0.01, depth_error=1e-6)
    # Up in the picture is up in the world.
    assert (frames.extrinsics[:, 1, 2] < -0.8).all()


def test_both_orientations_are_kept_apart(tmp_path: Path):
    written(tmp_path, 90.0)
    shapes = [
        ARKitScenes(tmp_path, upright=upright).read(NAME, [0]).images.shape[1:3] for upright in (True, False, True)
    ]
    assert shapes == [SIZE[::-1], SIZE, SIZE[::-1]]


def test_pictures_without_depth_calibration_or_pose_do_not_count(root: Path, video: Path):
    (video / "lowres_depth/41048190_100.000.png").unlink()
    (video / "vga_wide_intrinsics/41048190_100.034.pincam").rename(
        video / "vga_wide_intrinsics/41048190_100.035.pincam"
    )
    for folder, suffix in (("vga_wide", "png"), ("lowres_depth", "png"), ("vga_wide_intrinsics", "pincam")):
        source = video / folder / f"41048190_100.260.{suffix}"
        for time in ("99.998", "100.301", "100.302"):
            (video / folder / f"41048190_{time}.{suffix}").write_bytes(source.read_bytes())
    dataset = ARKitScenes(root)
    # In the order of time, not of the letters in the name.
    assert dataset.frame_names(NAME) == [f"41048190_{time}" for time in ("100.101", "100.260", "100.301")]
    assert dataset.dropped_frames(NAME) == {"no depth": 1, "no calibration": 1, "no pose": 2}


def test_pictures_that_need_a_lost_pose_do_not_count(root: Path, video: Path):
    lines = (video / "lowres_wide.traj").read_text().splitlines()
    lines[1] = "100.1 nan nan nan 0 0 0"
    (video / "lowres_wide.traj").write_text("\n".join(lines))
    dataset = ARKitScenes(root)
    assert dataset.frame_names(NAME) == ["41048190_100.000", "41048190_100.260"]
    assert dataset.dropped_frames(NAME) == {"no pose": 2}


def test_a_missing_line_of_the_trajectory_is_bridged_and_order_does_not_matter(root: Path, video: Path):
    lines = (video / "lowres_wide.traj").read_text().splitlines()
    (video / "lowres_wide.traj").write_text("\n".join([lines[3], "", lines[0], lines[2]]))
    extrinsics = ARKitScenes(root).read(NAME, [2]).extrinsics[0]
    centres = [pose[:3, 3] for pose in sensor_path()]
    centre = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    np.testing.assert_allclose(centre, centres[0] + 0.505 * (centres[2] - centres[0]), atol=1e-5)


def test_resized_pictures_have_intrinsics_of_their_size(root: Path, video: Path):
    path = video / "vga_wide/41048190_100.000.png"
    cv2.imwrite(str(path), cv2.imread(str(path))[::2, ::2])
    frames = ARKitScenes(root).read(NAME, [0])
    np.testing.assert_allclose(frames.intrinsics[0], [[55, 0, 36.25], [0, 56, 32.75], [0, 0, 1]], rtol=1e-6)
    assert frames.depth.shape == (1, 60, 80)


def test_splits_follow_the_folders(root: Path):
    with pytest.raises(FileNotFoundError, match="no sequences of ARKitScenes"):
        ARKitScenes(root, "val")
    written(root, name="Validation/41069021")
    (root / "raw/Training/notes").mkdir()
    assert ARKitScenes(root).sequences == (NAME, "Validation/41069021")
    assert ARKitScenes(root, "train").sequences == (NAME,)
    assert ARKitScenes(root, "val").sequences == ("Validation/41069021",)
    with pytest.raises(FileNotFoundError, match="raw/Training/<video>"):
        ARKitScenes(root / "raw")
