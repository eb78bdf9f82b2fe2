"""Neural RGB-D: OpenGL cameras, nan blocks, unpadded names; a written scene of known geometry comes back."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_sequence import assert_shows_room, room_frame

from logvggt_jax.data.readers.nrgbd import NRGBD

SIZE = (48, 64)
FOCAL = 554.2562584220408
INTRINSICS = pinhole(SIZE, FOCAL / 10, (31.55, 23.55))
STEP = 0.001


def write_scene(folder: Path, count: int = 12, lost: tuple[int, ...] = ()) -> None:
    for name in ("images", "depth", "depth_filtered"):
        (folder / name).mkdir(parents=True)
    lines = []
    for index in range(count):
        frame = room_frame(index, INTRINSICS, SIZE)
        cv2.imwrite(str(folder / f"images/img{index}.png"), frame.picture[..., ::-1])
        cv2.imwrite(str(folder / f"depth/depth{index}.png"), np.rint(frame.depth * 1000).astype(np.uint16))
        cv2.imwrite(str(folder / f"depth_filtered/depth{index}.png"), np.ones(SIZE, np.uint16))
        opengl = frame.pose.copy()
        opengl[:, 1:3] *= -1
        rows = np.full((4, 4), np.nan) if index in lost else opengl
        lines += [" ".join(f"{value:.10f}" for value in row) for row in rows]
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    (folder / "trainval_poses.txt").write_text("nan nan nan nan\n" * 4 * count)
    (folder / "focal.txt").write_text(f"{FOCAL}\n")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_scene(tmp_path / "kitchen")
    return tmp_path


def test_a_written_scene_comes_back_in_numeric_order(root: Path):
    (root / "meshes").mkdir()
    nrgbd = NRGBD(root)
    assert nrgbd.sequences == ("kitchen",) and nrgbd.metric
    assert nrgbd.frame_names("kitchen") == [f"img{i}" for i in range(12)]
    order = [2, 1, 3, 0]
    assert_shows_room(nrgbd.read("kitchen", order), order, INTRINSICS, depth_step=STEP)
    assert_shows_room(nrgbd.read("kitchen", [10, 11]), [10, 11], INTRINSICS, depth_step=STEP)


def test_nan_blocks_are_dropped_and_later_poses_stay_with_their_pictures(tmp_path: Path):
    write_scene(tmp_path / "kitchen", 6, lost=(0, 3))
    nrgbd = NRGBD(tmp_path)
    assert nrgbd.frame_names("kitchen") == ["img1", "img2", "img4", "img5"]
    assert nrgbd.dropped_frames("kitchen") == {"no pose": 2}
    assert_shows_room(nrgbd.read("kitchen", [0, 1, 2, 3]), [1, 2, 4, 5], INTRINSICS, depth_step=STEP)


def test_zero_and_far_depth_is_invalid(root: Path):
    depth = np.full(SIZE, 1500, np.uint16)
    depth[0, :4] = [0, 10_000, 10_001, 65_535]
    cv2.imwrite(str(root / "kitchen/depth/depth0.png"), depth)
    np.testing.assert_array_equal(NRGBD(root).read("kitchen", [0]).depth[0, 0, :5], np.float32([0, 10, 0, 0, 1.5]))


def test_infinite_poses_are_lost_too(root: Path):
    poses = root / "kitchen/poses.txt"
    lines = poses.read_text().splitlines()
    lines[4] = "-inf -inf -inf -inf"
    poses.write_text("\n".join(lines))
    assert NRGBD(root).dropped_frames("kitchen") == {"no pose": 1}


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_there_are_no_splits(root: Path, split: str):
    with pytest.raises(ValueError, match=f"Neural RGB-D has no split '{split}'"):
        NRGBD(root, split)


@pytest.mark.parametrize("kind", ["focal.txt", "poses.txt", "images/img5.png", "depth/depth5.png"])
def test_a_missing_file_is_named(root: Path, kind: str):
    (root / "kitchen" / kind).unlink()
    with pytest.raises(FileNotFoundError, match=f"{kind}: no such file"):
        NRGBD(root).num_frames("kitchen")


def test_pictures_and_poses_of_unequal_count_are_named(root: Path):
    poses = root / "kitchen/poses.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:-1]))
    with pytest.raises(ValueError, match=r"poses\.txt: expected 12 poses of 4 lines.*got 47 lines"):
        NRGBD(root).num_frames("kitchen")
    (root / "kitchen/images/img5.png").unlink()
    (root / "kitchen/depth/depth5.png").unlink()
    with pytest.raises(FileNotFoundError, match="images: frame 5 is missing"):
        NRGBD(root).num_frames("kitchen")


def test_a_mirrored_pose_and_an_absurd_focal_length_are_named(root: Path):
    (root / "kitchen/focal.txt").write_text("5.5")
    with pytest.raises(ValueError, match=r"img0\.png: intrinsics fx=0\.55"):
        NRGBD(root).read("kitchen", [0])
    (root / "kitchen/focal.txt").write_text("554 554")
    with pytest.raises(ValueError, match=r"focal\.txt: expected 1 numbers, got 2"):
        NRGBD(root).num_frames("kitchen")
    (root / "kitchen/focal.txt").write_text(str(FOCAL))
    poses = root / "kitchen/poses.txt"
    lines = poses.read_text().splitlines()
    lines[8:12] = ["-1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    poses.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"poses\.txt, pose of img2\.png: not a rigid transform"):
        NRGBD(root).num_frames("kitchen")
