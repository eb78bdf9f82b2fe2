"""ARKitScenes: the analytic room in the set's files comes back, whichever way up; times, splits and damage."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import camera_to_world, view
from room_views import RoomView, check_views
from scipy.spatial.transform import Rotation, Slerp

from logvggt_jax.data.readers.arkitscenes import ARKitScenes

NAME = "Training/41048190"
SIZE, COARSE = (120, 160), (48, 64)  # a factor of 2.5, as in the set
STORED = np.array([[110.0, 0, 73.0], [0, 112.0, 66.0], [0, 0, 1]])
# The room's world has y down, the set's has z up.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
POSE_TIMES = (100.0, 100.1, 100.2, 100.3)
# On a pose, 1 ms beside one, and in between.
PICTURE_TIMES = (100.0, 100.033, 100.101, 100.26)


def roll(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return pose


def sensor_path(degrees: float) -> list[np.ndarray]:
    """Camera-to-world of the trajectory's poses, for a tablet held turned by so many degrees."""
    return [Z_UP @ camera_to_world(index) @ roll(degrees) for index in range(len(POSE_TIMES))]


def pose_at(path: list[np.ndarray], time: float) -> np.ndarray:
    """Camera-to-world at a time, by SciPy's interpolation; at a pose's own time, and 1 ms beside it, that pose."""
    for index, known in enumerate(POSE_TIMES):
        if abs(time - known) < 0.0015:
            return path[index]
    pose = np.eye(4)
    rotations = Rotation.from_matrix(np.stack([known[:3, :3] for known in path]))
    pose[:3, :3] = Slerp(POSE_TIMES, rotations)([time]).as_matrix()[0]
    pose[:3, 3] = [np.interp(time, POSE_TIMES, [known[axis, 3] for known in path]) for axis in range(3)]
    return pose


def seen_from(pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    return view(Z_UP.T @ pose, intrinsics, size)


def coarse_depth(pose: np.ndarray) -> np.ndarray:
    intrinsics = STORED.copy()
    intrinsics[:2, 2] += 0.5
    intrinsics[:2] /= 2.5
    intrinsics[:2, 2] -= 0.5
    return np.rint(seen_from(pose, intrinsics, COARSE)[1] * 1000).astype(np.uint16)


def write_trajectory(video: Path, path: list[np.ndarray]) -> None:
    lines = []
    for time, pose in zip(POSE_TIMES, path, strict=True):
        stored = np.linalg.inv(pose)
        axis_angle = Rotation.from_matrix(stored[:3, :3]).as_rotvec()
        # The set's times have more digits than its names.
        lines.append(" ".join(f"{value:.9f}" for value in (time + 0.0002, *axis_angle, *stored[:3, 3])))
    (video / "lowres_wide.traj").write_text("\n".join(lines) + "\n")


def write_video(root: Path, name: str = NAME, degrees: float = 0.0) -> list[np.ndarray]:
    """Writes a video; returns the camera-to-world poses of its pictures, as the sensor is held."""
    video = root / "raw" / name
    for folder in ("vga_wide", "vga_wide_intrinsics", "lowres_depth", "confidence"):
        (video / folder).mkdir(parents=True)
    path = sensor_path(degrees)
    write_trajectory(video, path)
    poses = [pose_at(path, time) for time in PICTURE_TIMES]
    for index, (time, pose) in enumerate(zip(PICTURE_TIMES, poses, strict=True)):
        stem = f"{video.name}_{time:.3f}"
        picture, _ = seen_from(pose, STORED, SIZE)
        cv2.imwrite(str(video / f"vga_wide/{stem}.png"), picture[..., ::-1])
        cv2.imwrite(str(video / f"lowres_depth/{stem}.png"), coarse_depth(pose))
        cv2.imwrite(str(video / f"confidence/{stem}.png"), np.zeros(COARSE, np.uint8))
        # Calibrations of the second and third picture are 1 ms off.
        calibration = f"{video.name}_{time + (0, 0.001, -0.001, 0)[index]:.3f}.pincam"
        text = f"{SIZE[1]} {SIZE[0]} {STORED[0, 0]} {STORED[1, 1]} {STORED[0, 2]} {STORED[1, 2]}"
        (video / "vga_wide_intrinsics" / calibration).write_text(text)
    # Depth comes twice as often as pictures.
    cv2.imwrite(str(video / f"lowres_depth/{video.name}_100.016.png"), np.ones(COARSE, np.uint16))
    return poses


def stored_views(poses: list[np.ndarray]) -> list[RoomView]:
    """What the reader should hand out in the stored orientation."""
    rows, columns = (((np.arange(n) + 0.5) / 2.5).astype(int) for n in SIZE)
    views = []
    for pose in poses:
        depth = coarse_depth(pose)[rows[:, None], columns] / 1000
        views.append(RoomView(pose, STORED, seen_from(pose, STORED, SIZE)[0], depth))
    return views


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_video(tmp_path)
    return tmp_path


@pytest.fixture
def video(root: Path) -> Path:
    return root / "raw" / NAME


def shown(root: Path, degrees: float) -> tuple[list[RoomView], ARKitScenes]:
    return stored_views(write_video(root, degrees=degrees)), ARKitScenes(root, upright=False)


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, -90.0])
def test_the_room_comes_back_as_stored(tmp_path: Path, degrees: float):
    views, dataset = shown(tmp_path, degrees)
    frames = dataset.read(NAME, range(4))
    assert frames.metric
    check_views(frames, views, picture_error=0, depth_error=1e-6)
    assert dataset.frame_names(NAME) == [f"41048190_{time:.3f}" for time in PICTURE_TIMES]
    assert dataset.dropped_frames(NAME) == {}


H, W = SIZE
FX, FY, CX, CY = STORED[0, 0], STORED[1, 1], STORED[0, 2], STORED[1, 2]


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
    stored, _ = shown(tmp_path, held)
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
    write_video(tmp_path, degrees=90.0)
    shapes = [
        ARKitScenes(tmp_path, upright=upright).read(NAME, [0]).images.shape[1:3] for upright in (True, False, True)
    ]
    assert shapes == [SIZE[::-1], SIZE, SIZE[::-1]]


def test_zero_depth_is_invalid_and_an_empty_frame_is_read(root: Path, video: Path):
    cv2.imwrite(str(video / "lowres_depth/41048190_100.000.png"), np.zeros(COARSE, np.uint16))
    assert (ARKitScenes(root).read(NAME, [0]).depth == 0).all()


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
    centres = [pose[:3, 3] for pose in sensor_path(0)]
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
    write_video(root, "Validation/41069021")
    (root / "raw/Training/notes").mkdir()
    assert ARKitScenes(root).sequences == (NAME, "Validation/41069021")
    assert ARKitScenes(root, "train").sequences == (NAME,)
    assert ARKitScenes(root, "val").sequences == ("Validation/41069021",)
    with pytest.raises(ValueError, match="no split 'test'"):
        ARKitScenes(root, "test")
    with pytest.raises(FileNotFoundError, match="raw/Training/<video>"):
        ARKitScenes(root / "raw")


@pytest.mark.parametrize("name", ["vga_wide", "vga_wide_intrinsics", "lowres_depth", "lowres_wide.traj"])
def test_a_missing_part_is_named(root: Path, video: Path, name: str):
    (video / name).rename(video / "elsewhere")
    with pytest.raises(FileNotFoundError, match=f"41048190/{name}: no such f"):
        ARKitScenes(root).num_frames(NAME)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no poses"),
        ("100 0 0 0 1 2", "line 1: expected 7 numbers, got 6"),
        ("100 0 0 0 1 2 3\nnan 0 0 0 1 2 3", "line 2: expected a time"),
        ("pose", "expected numbers"),
    ],
)
def test_a_damaged_trajectory_is_named(root: Path, video: Path, text: str, complaint: str):
    (video / "lowres_wide.traj").write_text(text)
    with pytest.raises(ValueError, match=rf"lowres_wide\.traj.*{complaint}"):
        ARKitScenes(root).num_frames(NAME)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("160 120 110 112 73", "expected 6 numbers, got 5"),
        ("0 120 110 112 73 66", "above 0"),
        ("120 160 110 112 73 66", "shape of its calibration"),
        ("160 120 nan 112 73 66", ""),
        ("160 120 1 1 73 66", "intrinsics"),
    ],
)
def test_a_damaged_calibration_is_named(root: Path, video: Path, text: str, complaint: str):
    (video / "vga_wide_intrinsics/41048190_100.000.pincam").write_text(text)
    with pytest.raises(ValueError, match=rf"41048190_100\.000\.(pincam|png).*{complaint}"):
        ARKitScenes(root).read(NAME, [0])


def test_depth_of_another_shape_and_damaged_pictures_are_named(root: Path, video: Path):
    cv2.imwrite(str(video / "lowres_depth/41048190_100.000.png"), np.ones(COARSE[::-1], np.uint16))
    with pytest.raises(ValueError, match=r"lowres_depth/41048190_100\.000\.png: depth of 48 x 64"):
        ARKitScenes(root).read(NAME, [0])
    path = video / "vga_wide/41048190_100.033.png"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"vga_wide/41048190_100\.033\.png: truncated"):
        ARKitScenes(root).read(NAME, [1])
    cv2.imwrite(str(video / "lowres_depth/41048190_100.101.png"), np.ones(COARSE, np.uint8))
    with pytest.raises(ValueError, match=r"lowres_depth/41048190_100\.101\.png: expected 16-bit"):
        ARKitScenes(root).read(NAME, [2])
