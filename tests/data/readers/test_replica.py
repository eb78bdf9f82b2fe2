"""Replica: a written scene of known geometry comes back; the camera file decides; damage is named."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_sequence import assert_shows_room, room_frame

from logvggt_jax.data.readers.replica import Replica

SIZE = (48, 64)
INTRINSICS = pinhole(SIZE, 40.0, (30.5, 24.0))
CAMERA = {"w": 64, "h": 48, "fx": 40.0, "fy": 40.0, "cx": 30.5, "cy": 24.0, "scale": 6553.5}


def write_scene(folder: Path, count: int = 4, intrinsics: np.ndarray = INTRINSICS, size=SIZE) -> None:
    (folder / "results").mkdir(parents=True)
    lines = []
    for index in range(count):
        frame = room_frame(index, intrinsics, size)
        image, depth = folder / f"results/frame{index:06d}.jpg", folder / f"results/depth{index:06d}.png"
        cv2.imwrite(str(image), frame.picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
        cv2.imwrite(str(depth), np.rint(frame.depth * 6553.5).astype(np.uint16))
        lines.append(" ".join(f"{value:.18e}" for value in frame.pose.ravel()))
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_scene(tmp_path / "room0")
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    return tmp_path


def test_a_written_scene_comes_back(root: Path):
    write_scene(root / "office1", 3)
    (root / "room0_mesh.ply").write_bytes(b"ply")
    (root / "notes").mkdir()
    replica = Replica(root)
    assert replica.sequences == ("office1", "room0") and replica.metric
    assert replica.frame_names("room0") == [f"frame{i:06d}" for i in range(4)]
    order = [2, 0, 3]
    assert_shows_room(replica.read("room0", order), order, INTRINSICS, depth_step=1 / 6553.5, picture_error=2)


def test_intrinsics_scale_with_the_picture(root: Path):
    (root / "cam_params.json").write_text(
        json.dumps({"camera": CAMERA | {"w": 640, "h": 480, "fx": 400.0, "fy": 400.0, "cx": 309.5, "cy": 244.5}})
    )
    assert_shows_room(Replica(root).read("room0", [0, 1]), [0, 1], INTRINSICS, depth_step=1 / 6553.5, picture_error=2)


def test_without_the_camera_file_the_renderings_own_is_used(tmp_path: Path):
    size = (34, 60)
    intrinsics = pinhole(size, 30.0)
    write_scene(tmp_path / "room0", 3, intrinsics, size)
    frames = Replica(tmp_path).read("room0", [0, 1, 2])
    assert_shows_room(frames, [0, 1, 2], intrinsics, depth_step=1 / 6553.5, picture_error=2)


def test_zero_depth_stays_invalid(root: Path):
    cv2.imwrite(str(root / "room0/results/depth000001.png"), np.zeros(SIZE, np.uint16))
    frames = Replica(root).read("room0", [0, 1])
    assert not frames.depth[1].any() and frames.depth[0].all()


def test_lost_poses_are_dropped_and_counted(root: Path):
    trajectory = root / "room0/traj.txt"
    lines = trajectory.read_text().splitlines()
    lines[1] = " ".join(["nan"] * 16)
    trajectory.write_text("\n".join(lines))
    replica = Replica(root)
    assert replica.frame_names("room0") == ["frame000000", "frame000002", "frame000003"]
    assert replica.dropped_frames("room0") == {"no pose": 1}
    assert_shows_room(replica.read("room0", [0, 1]), [0, 2], INTRINSICS, depth_step=1 / 6553.5, picture_error=2)


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_there_are_no_splits(root: Path, split: str):
    with pytest.raises(ValueError, match=f"Replica has no split '{split}'"):
        Replica(root, split)


def test_missing_and_superfluous_files_are_named(root: Path):
    trajectory = root / "room0/traj.txt"
    text = trajectory.read_text()
    trajectory.write_text(text + text.splitlines()[0])
    with pytest.raises(ValueError, match=r"traj\.txt: expected 4 poses.*got 5 lines"):
        Replica(root).num_frames("room0")
    trajectory.write_text(text.replace(" ", " 7 ", 1))
    with pytest.raises(ValueError, match=r"traj\.txt, line 1: expected 16 numbers, got 17"):
        Replica(root).num_frames("room0")
    trajectory.unlink()
    with pytest.raises(FileNotFoundError, match=r"traj\.txt: no such file"):
        Replica(root).num_frames("room0")
    for kind in ("depth000001.png", "frame000001.jpg"):
        (root / "room0/results" / kind).unlink()
        with pytest.raises(FileNotFoundError, match=rf"{kind}: no such file|results: frame 1 is missing"):
            Replica(root).num_frames("room0")


def test_scaled_rotations_are_named(root: Path):
    trajectory = root / "room0/traj.txt"
    lines = trajectory.read_text().splitlines()
    lines[2] = " ".join(str(value) for value in np.diag([2.0, 2.0, 2.0, 1.0]).ravel())
    trajectory.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"traj\.txt, line 3: not a rigid transform"):
        Replica(root).num_frames("room0")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "expected"),
        ("[1]", "expected"),
        (json.dumps({"camera": {"w": 64}}), "expected.*'h'"),
        (json.dumps({"camera": CAMERA | {"scale": 0}}), "must be positive"),
        (json.dumps({"camera": CAMERA | {"fx": "wide"}}), "expected.*wide"),
    ],
)
def test_a_damaged_camera_file_is_named(root: Path, text: str, complaint: str):
    (root / "cam_params.json").write_text(text)
    with pytest.raises(ValueError, match=rf"cam_params\.json.*{complaint}"):
        Replica(root).num_frames("room0")


def test_a_camera_that_cannot_belong_to_the_pictures_is_refused(root: Path):
    (root / "cam_params.json").write_text(json.dumps({"camera": CAMERA | {"cx": 500.0}}))
    with pytest.raises(ValueError, match=r"frame000000\.jpg: intrinsics.*cannot belong"):
        Replica(root).read("room0", [0])
