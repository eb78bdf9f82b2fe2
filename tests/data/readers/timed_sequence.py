"""A sequence in TUM's format that shows the analytic room, for the tests of its readers to write."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from analytic_room import camera_to_world
from room_sequence import room_frame
from scipy.spatial.transform import Rotation

SIZE = (48, 64)
STEP = 1 / 5000
START = 1305031102.0
# Seconds of the pictures; pose i of the room is the one at PICTURES[i]. Depth lags by 7 ms; the motion capture has
# 100 poses a second, off the pictures' times.
PICTURES = START + np.arange(5) / 30
DEPTHS = PICTURES + 0.007
POSES = START - 0.0513 + np.arange(40) / 100


def write_pictures(folder: Path, depth_folder: Path, intrinsics: np.ndarray, *, depths: np.ndarray = DEPTHS) -> None:
    for place in (folder, depth_folder):
        place.mkdir(parents=True)
    for index, (time, depth_time) in enumerate(zip(PICTURES, depths, strict=True)):
        frame = room_frame(index, intrinsics, SIZE)
        cv2.imwrite(str(folder / f"{time:.6f}.png"), frame.picture[..., ::-1])
        cv2.imwrite(str(depth_folder / f"{depth_time:.6f}.png"), np.rint(frame.depth * 5000).astype(np.uint16))


def trajectory_line(time: float, pose: np.ndarray) -> str:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # x y z w
    return " ".join([f"{time:.4f}", *(f"{value:.9f}" for value in (*pose[:3, 3], *quaternion))])


def wrong_pose() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = 100
    return pose


def write_trajectory(path: Path, times: np.ndarray = POSES) -> None:
    """At each time the pose of the picture to which it is nearest of all times, else one that fits no picture."""
    lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    nearest = {int(np.abs(times - picture).argmin()): index for index, picture in enumerate(PICTURES)}
    for place, time in enumerate(times):
        lines.append(trajectory_line(time, camera_to_world(nearest[place]) if place in nearest else wrong_pose()))
    path.write_text("\n".join(lines) + "\n")


def write_list(path: Path, folder: str, times: np.ndarray) -> None:
    lines = [f"{time:.6f} {folder}/{time:.6f}.png" for time in times]
    path.write_text("\n".join(["# timestamp filename", *lines]) + "\n")


def write_sequence(folder: Path, intrinsics: np.ndarray) -> None:
    write_pictures(folder / "rgb", folder / "depth", intrinsics)
    write_list(folder / "rgb.txt", "rgb", PICTURES)
    write_list(folder / "depth.txt", "depth", DEPTHS)
    write_trajectory(folder / "groundtruth.txt")
