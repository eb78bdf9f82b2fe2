"""ScanNet: both layouts of a written scene of known geometry come back; lost poses, sizes, splits, damage."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_sequence import assert_shows_room, room_frame

from logvggt_jax.data.readers.scannet import ScanNet

SIZE, COLOUR_SIZE = (48, 64), (97, 130)
INTRINSICS = pinhole(SIZE, 42.0, (31.0, 24.5))
STEP = 0.001
ORDER = [0, 2, 1]


def colour_intrinsics() -> np.ndarray:
    """The depth camera as one of the colour camera's size: c' = (c + 0.5) s - 0.5."""
    scale = np.array([COLOUR_SIZE[1] / SIZE[1], COLOUR_SIZE[0] / SIZE[0]])
    matrix = INTRINSICS.copy()
    matrix[[0, 1], [0, 1]] *= scale
    matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
    return matrix


def write_frame(index: int, image: Path, depth: Path) -> np.ndarray:
    colour = room_frame(index, colour_intrinsics(), COLOUR_SIZE).picture
    frame = room_frame(index, INTRINSICS, SIZE)
    for path in (image, depth):
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(image), colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
    cv2.imwrite(str(depth), np.rint(frame.depth * 1000).astype(np.uint16))
    return frame.pose


def write_intrinsics(scene: Path) -> None:
    (scene / "intrinsic").mkdir(parents=True)
    for name, matrix in (("depth", INTRINSICS), ("color", colour_intrinsics())):
        padded = np.eye(4)
        padded[:3, :3] = matrix
        np.savetxt(scene / "intrinsic" / f"intrinsic_{name}.txt", padded)
        np.savetxt(scene / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4))


def write_scene(scene: Path, numbers: tuple[int, ...] = (8, 9, 10)) -> None:
    """The export; picture `numbers[i]` is the room's pose i."""
    write_intrinsics(scene)
    (scene / "pose").mkdir()
    for index, number in enumerate(numbers):
        pose = write_frame(index, scene / f"color/{number}.jpg", scene / f"depth/{number}.png")
        np.savetxt(scene / f"pose/{number}.txt", pose)


def write_prepared(scene: Path, count: int = 90) -> None:
    write_intrinsics(scene)
    poses = [
        write_frame(
            index, scene / f"color_{count}/frame_{index:04d}.jpg", scene / f"depth_{count}/frame_{index:04d}.png"
        )
        for index in range(4)
    ]
    np.savetxt(scene / f"pose_{count}.txt", np.reshape(poses, (4, 16)))


def lose(path: Path, row: int | None = None) -> None:
    """Lost tracking as the export writes it."""
    values = np.loadtxt(path)
    values[... if row is None else row] = -np.inf
    np.savetxt(path, values)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_scene(tmp_path / "scans_train/scene0000_00")
    write_scene(tmp_path / "scans_test/scene0707_00")
    return tmp_path


def test_a_written_export_comes_back_at_the_depth_cameras_size_in_numeric_order(root: Path):
    scans = ScanNet(root)
    assert scans.sequences == ("scene0000_00", "scene0707_00") and scans.metric
    assert scans.frame_names("scene0000_00") == ["8", "9", "10"]
    frames = scans.read("scene0000_00", ORDER)
    assert frames.images.shape == (3, *SIZE, 3)
    assert_shows_room(frames, ORDER, INTRINSICS, depth_step=STEP, picture_error=3)


def test_colour_is_averaged_over_the_pixels_that_a_depth_pixel_covers(root: Path):
    v, u = np.indices((2 * SIZE[0], 2 * SIZE[1]))
    board = np.repeat((((u + v) % 2) * 200).astype(np.uint8)[..., None], 3, axis=2)
    path = root / "scans_train/scene0000_00/color/8.jpg"
    cv2.imwrite(str(path), board, [cv2.IMWRITE_JPEG_QUALITY, 100])
    image = ScanNet(root).read("scene0000_00", [0]).images[0]
    assert np.abs(image.astype(int) - 100).max() <= 5


@pytest.mark.parametrize("part", ["scannetv2", "."])
def test_other_folders_of_scenes_are_read(tmp_path: Path, part: str):
    write_scene(tmp_path / part / "scene0011_01")
    (tmp_path / "scans").mkdir()
    scans = ScanNet(tmp_path)
    assert scans.sequences == ("scene0011_01",)
    assert_shows_room(scans.read("scene0011_01", ORDER), ORDER, INTRINSICS, depth_step=STEP, picture_error=3)


def test_the_prepared_form_comes_back(tmp_path: Path):
    scene = tmp_path / "scannetv2/scene0707_00"
    write_prepared(scene)
    scans = ScanNet(tmp_path)
    assert scans.sequences == ("scene0707_00/color_90",)
    name = scans.sequences[0]
    assert scans.frame_names(name) == [f"frame_{i:04d}" for i in range(4)]
    assert_shows_room(scans.read(name, ORDER), ORDER, INTRINSICS, depth_step=STEP, picture_error=3)
    lose(scene / "pose_90.txt", row=1)
    scans = ScanNet(tmp_path)
    assert scans.dropped_frames(name) == {"no pose": 1}
    assert_shows_room(scans.read(name, [0, 1, 2]), [0, 2, 3], INTRINSICS, depth_step=STEP, picture_error=3)


def test_the_export_goes_before_what_was_prepared_from_it(root: Path):
    scene = root / "scans_test/scene0707_00"
    for name in ("color_90", "depth_90"):
        (scene / name).mkdir()
    assert ScanNet(root, "test").sequences == ("scene0707_00",)


def test_prepared_poses_of_another_count_are_named(tmp_path: Path):
    scene = tmp_path / "scene0707_00"
    write_prepared(scene, 50)
    np.savetxt(scene / "pose_50.txt", np.loadtxt(scene / "pose_50.txt")[:3])
    with pytest.raises(ValueError, match=r"pose_50\.txt: expected 4 poses.*got 3 lines"):
        ScanNet(tmp_path).num_frames("scene0707_00/color_50")
    (scene / "pose_50.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"pose_50\.txt: no such file"):
        ScanNet(tmp_path).num_frames("scene0707_00/color_50")


def test_lost_poses_are_dropped_and_counted(root: Path):
    lose(root / "scans_train/scene0000_00/pose/9.txt")
    scans = ScanNet(root)
    assert scans.frame_names("scene0000_00") == ["8", "10"]
    assert scans.dropped_frames("scene0000_00") == {"no pose": 1}
    assert_shows_room(scans.read("scene0000_00", [0, 1]), [0, 2], INTRINSICS, depth_step=STEP, picture_error=3)


def test_a_scene_without_any_pose_is_named(root: Path):
    for number in (8, 9, 10):
        lose(root / f"scans_train/scene0000_00/pose/{number}.txt")
    with pytest.raises(ValueError, match=r"scene0000_00: no frame of ScanNet counts.*no pose.*3"):
        ScanNet(root).num_frames("scene0000_00")


def test_scenes_whose_intrinsics_are_not_finite_are_left_out(root: Path):
    lose(root / "scans_train/scene0000_00/intrinsic/intrinsic_depth.txt")
    assert ScanNet(root).sequences == ("scene0707_00",)


def test_zero_depth_is_invalid(root: Path):
    depth = np.full(SIZE, 2000, np.uint16)
    depth[3, 4] = 0
    cv2.imwrite(str(root / "scans_train/scene0000_00/depth/8.png"), depth)
    read = ScanNet(root).read("scene0000_00", [0]).depth[0]
    assert read[3, 4] == 0 and (np.delete(read.ravel(), 3 * SIZE[1] + 4) == 2).all()


def test_folders_decide_the_split_where_there_are_no_lists(root: Path):
    assert ScanNet(root, "train").sequences == ("scene0000_00",)
    assert ScanNet(root, "test").sequences == ("scene0707_00",)
    with pytest.raises(FileNotFoundError, match=r"scannetv2_val\.txt: no such file"):
        ScanNet(root, "val")


def test_official_lists_decide_where_there_is_one(root: Path):
    write_scene(root / "scans_train/scene0011_00")
    (root / "scannetv2_val.txt").write_text("scene0011_00\n")
    assert ScanNet(root, "val").sequences == ("scene0011_00",)
    assert ScanNet(root).sequences == ("scene0000_00", "scene0011_00", "scene0707_00")
    with pytest.raises(FileNotFoundError, match=r"scannetv2_train\.txt: no such file"):
        ScanNet(root, "train")
    (root / "scannetv2_train.txt").write_text("scene0000_00\nscene0001_00\n")
    with pytest.raises(FileNotFoundError, match=r"no folder of scene scene0001_00.*scannetv2_train\.txt"):
        ScanNet(root, "train")
    (root / "scannetv2_train.txt").write_text("scene0000_00\n")
    assert ScanNet(root, "train").sequences == ("scene0000_00",)


def test_a_scene_in_two_places_is_refused(root: Path):
    write_scene(root / "scannetv2/scene0707_00")
    with pytest.raises(ValueError, match=r"scannetv2/scene0707_00 and .*scans_test/scene0707_00 are the same"):
        ScanNet(root)


@pytest.mark.parametrize("kind", ["color/9.jpg", "depth/9.png", "pose/9.txt", "intrinsic/intrinsic_depth.txt"])
def test_a_missing_file_is_named(root: Path, kind: str):
    (root / "scans_train/scene0000_00" / kind).unlink()
    with pytest.raises(FileNotFoundError, match=f"scene0000_00/{kind}: no such file"):
        ScanNet(root).num_frames("scene0000_00")


def test_damaged_files_are_named(root: Path):
    scene = root / "scans_train/scene0000_00"
    for path in (scene / "color/9.jpg", scene / "depth/10.png"):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        with pytest.raises(ValueError, match=rf"{path.name}: truncated"):
            ScanNet(root).read("scene0000_00", [0, 1, 2])
        path.write_bytes(content)
    cv2.imwrite(str(scene / "color/9.jpg"), np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(ValueError, match=r"depth/9\.png: 64 x 48 has another aspect ratio than 48 x 64"):
        ScanNet(root).read("scene0000_00", [0, 1])
    (scene / "pose/9.txt").write_text("1 0 0 0\n" * 3)
    with pytest.raises(ValueError, match=r"pose/9\.txt: expected 16 numbers, got 12"):
        ScanNet(root).num_frames("scene0000_00")
