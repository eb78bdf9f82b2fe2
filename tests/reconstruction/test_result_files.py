"""What is written can be read back and follows its format."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from logvggt_jax.colours import depth_picture
from logvggt_jax.data import open_dataset
from logvggt_jax.errors import InputError, MissingInput
from logvggt_jax.geometry import camera_centres, invert, quaternion_to_matrix, rotation_angle
from logvggt_jax.reconstruction.cameras_file import read_cameras, write_cameras
from logvggt_jax.reconstruction.depth_files import read_depth, read_picture, write_depth, write_picture
from logvggt_jax.reconstruction.exporters.tum import read_trajectory, write_trajectory
from logvggt_jax.reconstruction.points.cloud_file import read_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.room_sequence import read_room_sequence, write_room_sequence


def random_extrinsics(count: int) -> np.ndarray:
    generator = np.random.default_rng(0)
    rotation = quaternion_to_matrix(generator.standard_normal((count, 4)))
    return np.concatenate([rotation, generator.standard_normal((count, 3, 1))], axis=2)


def test_trajectory_round_trip_and_format(tmp_path: Path) -> None:
    extrinsics = random_extrinsics(20)
    timestamps = np.arange(20) / 30.0
    write_trajectory(tmp_path / "t.txt", timestamps, extrinsics)
    times, poses = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(times, timestamps, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, 3], extrinsics[:, :3, 3], atol=1e-7)
    assert rotation_angle(poses[:, :3, :3], extrinsics[:, :3, :3]).max() < 1e-7
    # Columns: position of the camera in the world, then the camera-to-world quaternion, scalar last.
    row = np.array((tmp_path / "t.txt").read_text().splitlines()[1].split(), float)
    np.testing.assert_allclose(row[1:4], camera_centres(extrinsics)[0], atol=1e-7)
    np.testing.assert_allclose(quaternion_to_matrix(row[4:]), extrinsics[0, :3, :3].T, atol=1e-7)


def test_trajectory_refuses_what_it_cannot_mean(tmp_path: Path) -> None:
    extrinsics = random_extrinsics(3)
    with pytest.raises(ValueError, match="2 time stamps for 3 poses"):
        write_trajectory(tmp_path / "t.txt", [0, 1], extrinsics)
    extrinsics[1, 0, 3] = np.nan
    with pytest.raises(ValueError, match="pose 1 is not finite"):
        write_trajectory(tmp_path / "t.txt", [0, 1, 2], extrinsics)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "bad.txt").write_text("# comment\n0 1 2 3 0 0 0 1\n1 2 3\n")
    with pytest.raises(ValueError, match=r"bad\.txt:3: expected 8 numbers"):
        read_trajectory(tmp_path / "bad.txt")


def test_cameras_round_trip(tmp_path: Path) -> None:
    extrinsics = random_extrinsics(4)
    intrinsics = np.tile(np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), (4, 1, 1))
    write_cameras(
        tmp_path / "cameras.json",
        names=["a", "b", "c", "d"],
        timestamps=[0.0, 0.5, 1.0, 1.5],
        extrinsics=extrinsics,
        intrinsics=intrinsics,
        image_size=(480, 640),
        model_intrinsics=np.diag([0.5, 0.5, 1]) @ intrinsics,
        model_size=(240, 320),
        point_filter=PointFilter(40.0, None, 2, 100),
    )
    cameras = read_cameras(tmp_path / "cameras.json")
    assert cameras["points"] == PointFilter(40.0, None, 2, 100)
    assert cameras["image_size"] == [480, 640]
    assert [frame["name"] for frame in cameras["frames"]] == ["a", "b", "c", "d"]
    np.testing.assert_array_equal([frame["extrinsics"] for frame in cameras["frames"]], extrinsics)
    np.testing.assert_array_equal(
        [frame["depth_intrinsics"] for frame in cameras["frames"]], np.diag([0.5, 0.5, 1]) @ intrinsics
    )


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"0 1 2 3 0 0 0 1\n\xff\xfe 1 2 3 0 0 0 1\n", r"bad\.txt:2: expected 8 numbers"),
        (b"0 1 2 nan 0 0 0 1\n", r"bad\.txt:1: expected 8 numbers .* finite ones"),
        (b"inf 1 2 3 0 0 0 1\n", r"bad\.txt:1: expected 8 numbers .* finite ones"),
        (b"0 1 2 1e300 0 0 0 1\n", r"bad\.txt:1: expected 8 numbers .* finite ones"),
        (b"# two\n0 1 2 3 0 0 0 0\n", r"bad\.txt:2: the quaternion qx qy qz qw is zero"),
        (b"", r"bad\.txt holds no pose"),
    ],
)
def test_what_is_wrong_with_a_trajectory_is_named_with_its_line(tmp_path: Path, content: bytes, complaint: str) -> None:
    (tmp_path / "bad.txt").write_bytes(content)
    with pytest.raises(InputError, match=complaint) as caught:
        read_trajectory(tmp_path / "bad.txt")
    assert "\n" not in str(caught.value)


def test_times_in_nanoseconds_are_times(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("1600000000000000000 1 2 3 0 0 0 1\n")
    assert read_trajectory(tmp_path / "t.txt")[0].tolist() == [1.6e18]


def test_a_pipe_is_no_file_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for read in (read_trajectory, read_cameras, read_depth, read_picture, read_points):
        with pytest.raises(InputError, match="pipe is no file"):
            read(tmp_path / "pipe")


@pytest.mark.parametrize("content", ["{", "[]", "[" * 100_000, "{}", json.dumps({"format": "other", "frames": []})])
def test_other_files_are_no_cameras(tmp_path: Path, content: str) -> None:
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(ValueError, match=r"cameras\.json"):
        read_cameras(tmp_path / "cameras.json")
    with pytest.raises(FileNotFoundError, match="logvggt reconstruct"):
        read_cameras(tmp_path / "none.json")


def test_depth_comes_back_as_announced(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    depth = generator.uniform(0.1, 50, (6, 8)).astype(np.float32)
    confidence = 1 + np.exp(generator.uniform(-5, 20, (6, 8)).astype(np.float32))
    stored, stored_confidence = write_depth(tmp_path / "d.npz", depth, confidence)
    read, read_confidence = read_depth(tmp_path / "d.npz")
    assert read.dtype == read_confidence.dtype == np.float32
    np.testing.assert_allclose(read, depth, rtol=5e-4)
    assert np.isfinite(read_confidence).all()
    np.testing.assert_array_equal(read, stored)
    np.testing.assert_array_equal(read_confidence, stored_confidence)


def test_depth_picture_is_brighter_when_nearer_and_black_where_invalid(tmp_path: Path) -> None:
    depth = np.array([[0.0, 1.0, 2.0, 4.0, np.nan]], np.float32)
    picture = depth_picture(depth, near=1.0, far=5.0)
    brightness = picture[0].astype(int).sum(1)
    assert brightness[0] == brightness[4] == 0
    assert brightness[1] > brightness[2] > brightness[3]
    write_picture(tmp_path / "p.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "p.png"))[..., ::-1], picture)


def test_a_room_sequence_is_read_back_as_it_was_rendered(tmp_path: Path) -> None:
    folder = write_room_sequence(tmp_path / "room", num_frames=3, image_size=(28, 42), seed=3, progress=False)
    rooms = open_dataset("rooms", None, "test", height=28, width=42, num_frames=3, num_rooms=1, seed=3)
    found, expected = read_room_sequence(folder), rooms.read(rooms.sequences[0], range(3))
    np.testing.assert_array_equal(found.images, expected.images)
    np.testing.assert_allclose(found.depth, expected.depth, atol=6e-4)
    for name in ("intrinsics", "extrinsics"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-5)
    with pytest.raises(MissingInput, match="holds no frame"):
        read_room_sequence(tmp_path)


def test_room_sequence_has_consistent_depth_poses_and_intrinsics(tmp_path: Path) -> None:
    folder = write_room_sequence(tmp_path / "room", num_frames=3, image_size=(48, 64), seed=3, progress=False)
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(
        [f"frame-00000{i}.{kind}" for i in range(3) for kind in ("color.png", "depth.proj.png", "pose.txt")]
        + ["intrinsics.txt"]
    )
    intrinsics = np.loadtxt(folder / "intrinsics.txt")
    colours = [cv2.imread(str(folder / f"frame-00000{i}.color.png")).astype(float) for i in range(3)]
    depths = [cv2.imread(str(folder / f"frame-00000{i}.depth.proj.png"), cv2.IMREAD_UNCHANGED) for i in range(3)]
    poses = [np.loadtxt(folder / f"frame-00000{i}.pose.txt") for i in range(3)]
    assert depths[0].dtype == np.uint16
    # A pixel's point, carried into the next camera, lies at that camera's depth and shows the same colour.
    v, u = np.mgrid[0:48, 0:64]
    depth = depths[0] / 1000.0
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsics).T
    points = rays.reshape(-1, 3) * depth.reshape(-1, 1)
    moved = invert(poses[1])[:3] @ poses[0] @ np.concatenate([points, np.ones((len(points), 1))], 1).T
    pixels = (intrinsics @ moved)[:2] / moved[2]
    column, row = np.rint(pixels).astype(int)
    inside = (column >= 0) & (column < 64) & (row >= 0) & (row < 48)
    difference = np.abs(depths[1][row[inside], column[inside]] / 1000.0 - moved[2][inside])
    assert inside.mean() > 0.5
    assert np.median(difference) < 0.02
    shown = np.abs(colours[1][row[inside], column[inside]] - colours[0].reshape(-1, 3)[inside]).mean(1)
    assert np.median(shown) < np.abs(colours[1] - colours[0].mean((0, 1))).mean() / 3
