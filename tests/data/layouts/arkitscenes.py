"""ARKitScenes: coarse depth, a calibration file a picture, a trajectory of axis-angle vectors with the world's z up."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from analytic_room import camera_to_world, view
from room_views import RoomView, millimetres, write_image
from scipy.spatial.transform import Rotation, Slerp

from layouts.layout import Layout, written
from logvggt_jax.data.readers.arkitscenes import ARKitScenes

NAME = "Training/41048190"
SIZE, COARSE = (120, 160), (48, 64)  # a factor of 2.5, as in the set
INTRINSICS = np.array([[110.0, 0, 73.0], [0, 112.0, 66.0], [0, 0, 1]])
# The room's world has y down, the set's has z up.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
POSE_TIMES = (100.0, 100.1, 100.2, 100.3)
# On a pose, 1 ms beside one, and in between.
PICTURE_TIMES = (100.0, 100.033, 100.101, 100.26)
ROWS, COLUMNS = (((np.arange(n) + 0.5) / 2.5).astype(int) for n in SIZE)  # of coarse depth, for each pixel


def roll(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return pose


def sensor_path(degrees: float = 0.0) -> list[np.ndarray]:
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


def stored_view(pose: np.ndarray) -> RoomView:
    """The picture, and the coarse depth of its pixels in whole millimetres."""
    coarse = INTRINSICS.copy()
    coarse[:2, 2] += 0.5
    coarse[:2] /= 2.5
    coarse[:2, 2] -= 0.5
    depth = millimetres(seen_from(pose, coarse, COARSE)[1]) / 1000
    return RoomView(pose, INTRINSICS, seen_from(pose, INTRINSICS, SIZE)[0], depth[ROWS[:, None], COLUMNS])


def stored_views(path: list[np.ndarray], times: Sequence[float] = PICTURE_TIMES) -> list[RoomView]:
    return [stored_view(pose_at(path, time)) for time in times]


def write_trajectory(video: Path, path: Sequence[np.ndarray]) -> None:
    lines = []
    for time, pose in zip(POSE_TIMES, path, strict=True):
        vectors = np.full(6, np.nan)
        if np.isfinite(pose).all():
            stored = np.linalg.inv(pose)
            vectors = np.concatenate([Rotation.from_matrix(stored[:3, :3]).as_rotvec(), stored[:3, 3]])
        # The set's times have more digits than its names.
        lines.append(" ".join(f"{value:.9f}" for value in (time + 0.0002, *vectors)))
    (video / "lowres_wide.traj").write_text("\n".join(lines) + "\n")


def write_video(
    root: Path, path: Sequence[np.ndarray], views: Sequence[RoomView], times: Sequence[float], name: str = NAME
) -> None:
    video = root / "raw" / name
    for folder in ("vga_wide_intrinsics", "confidence"):
        (video / folder).mkdir(parents=True)
    write_trajectory(video, path)
    for index, (time, each) in enumerate(zip(times, views, strict=True)):
        stem = f"{video.name}_{time:.3f}"
        write_image(video / f"vga_wide/{stem}.png", each.picture)
        # Of each coarse pixel's copies, the first.
        height, width = each.depth.shape
        rows, columns = (np.unique(place, return_index=True)[1] for place in (ROWS[:height], COLUMNS[:width]))
        write_image(video / f"lowres_depth/{stem}.png", millimetres(each.depth[rows[:, None], columns]))
        write_image(video / f"confidence/{stem}.png", np.zeros(COARSE, np.uint8))
        # Calibrations of the second and third picture are 1 ms off.
        calibration = f"{video.name}_{time + (0, 0.001, -0.001, 0)[index]:.3f}.pincam"
        text = f"{SIZE[1]} {SIZE[0]} {INTRINSICS[0, 0]} {INTRINSICS[1, 1]} {INTRINSICS[0, 2]} {INTRINSICS[1, 2]}"
        (video / "vga_wide_intrinsics" / calibration).write_text(text)
    # Depth comes twice as often as pictures.
    write_image(video / f"lowres_depth/{video.name}_100.016.png", np.ones(COARSE, np.uint16))


def write(root: Path, views: Sequence[RoomView]) -> None:
    """Every picture at the time of a pose."""
    write_video(root, [each.pose for each in views], views, POSE_TIMES)


VIDEO = f"raw/{NAME}"
LAYOUT = Layout(
    ARKitScenes,
    NAME,
    write,
    names=[f"41048190_{time:.3f}" for time in POSE_TIMES],
    image=f"{VIDEO}/vga_wide/41048190_100.100.png",
    depth=f"{VIDEO}/lowres_depth/41048190_100.100.png",
    needed=[f"{VIDEO}/{name}" for name in ("vga_wide", "vga_wide_intrinsics", "lowres_depth", "lowres_wide.traj")],
    tables=(f"{VIDEO}/lowres_wide.traj", f"{VIDEO}/vga_wide_intrinsics/41048190_100.101.pincam"),
    views=stored_views(sensor_path(), POSE_TIMES),
    poses="rigid",
    damages=(
        *(
            (rf"lowres_wide\.traj.*{complaint}", written(f"{VIDEO}/lowres_wide.traj", text))
            for text, complaint in (
                ("", "no poses"),
                ("100 0 0 0 1 2", "line 1: expected 7 numbers, got 6"),
                ("100 0 0 0 1 2 3\nnan 0 0 0 1 2 3", "line 2: expected a time"),
            )
        ),
        *(
            (
                rf"41048190_100\.000\.(pincam|png).*{complaint}",
                written(f"{VIDEO}/vga_wide_intrinsics/41048190_100.000.pincam", text),
            )
            for text, complaint in (
                ("160 120 110 112 73", "expected 6 numbers, got 5"),
                ("0 120 110 112 73 66", "above 0"),
                ("120 160 110 112 73 66", "shape of its calibration"),
                ("160 120 nan 112 73 66", ""),
                ("160 120 1 1 73 66", "intrinsics"),
            )
        ),
    ),
)
