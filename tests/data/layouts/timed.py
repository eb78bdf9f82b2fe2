"""TUM RGB-D and Bonn: pictures, depth and poses with clocks of their own."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import RoomView, room_views, write_image
from scipy.spatial.transform import Rotation

from layouts.layout import Layout, relined, removed, written
from logvggt_jax.data.readers.bonn import Bonn
from logvggt_jax.data.readers.tum import TUM

STEP = 1 / 5000
START = 1305031102.0
# Seconds of the pictures; view i is the one at PICTURES[i]. Depth lags by 7 ms; the motion capture has 100 poses a
# second, off the pictures' times.
PICTURES = START + np.arange(5) / 30
DEPTHS = PICTURES + 0.007
POSES = START - 0.0513 + np.arange(40) / 100
NAMES = [f"{time:.6f}" for time in PICTURES]
# A tenth of 640 x 480: c' = (c + 0.5) / 10 - 0.5.
TUM_VIEWS = room_views(5, np.array([[53.54, 0, 31.56], [0, 53.92, 24.31], [0, 0, 1]]))
BONN_VIEWS = room_views(5, np.array([[54.2822841, 0, 31.109352], [0, 54.257687, 23.3256098], [0, 0, 1]]))
WRONG = np.eye(4) + 100 * np.eye(4, k=3)
TUM_NAME, BONN_NAME = "rgbd_dataset_freiburg3_walking_xyz", "rgbd_bonn_balloon2"


def write_pictures(folder: Path, depth_folder: Path, views: Sequence[RoomView], *, depths: np.ndarray = DEPTHS) -> None:
    for time, depth_time, each in zip(PICTURES, depths, views, strict=True):
        write_image(folder / f"{time:.6f}.png", each.picture)
        write_image(depth_folder / f"{depth_time:.6f}.png", np.rint(each.depth / STEP).astype(np.uint16))


def trajectory_line(time: float, pose: np.ndarray) -> str:
    """A scaled rotation becomes a quaternion of that length."""
    quaternion = np.full(4, np.nan)
    if np.isfinite(pose).all():
        scale = np.cbrt(np.linalg.det(pose[:3, :3]))
        quaternion = scale * Rotation.from_matrix(pose[:3, :3] / scale).as_quat()  # x y z w
    return " ".join([f"{time:.4f}", *(f"{value:.9f}" for value in (*pose[:3, 3], *quaternion))])


def write_trajectory(path: Path, views: Sequence[RoomView], times: np.ndarray = POSES) -> None:
    """At each time the pose of the picture to which it is nearest of all times, else one that fits no picture."""
    lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    nearest = {int(np.abs(times - time).argmin()): each.pose for time, each in zip(PICTURES, views, strict=True)}
    lines += [trajectory_line(time, nearest.get(place, WRONG)) for place, time in enumerate(times)]
    path.write_text("\n".join(lines) + "\n")


def write_list(path: Path, folder: str, times: np.ndarray) -> None:
    lines = [f"{time:.6f} {folder}/{time:.6f}.png" for time in times]
    path.write_text("\n".join(["# timestamp filename", *lines]) + "\n")


def write_sequence(folder: Path, views: Sequence[RoomView]) -> None:
    write_pictures(folder / "rgb", folder / "depth", views)
    write_list(folder / "rgb.txt", "rgb", PICTURES)
    write_list(folder / "depth.txt", "depth", DEPTHS)
    write_trajectory(folder / "groundtruth.txt", views)


def _layout(reader: type[TUM | Bonn], name: str, views: Sequence[RoomView]) -> Layout:
    files = [f"{name}/rgb/{PICTURES[1]:.6f}.png", f"{name}/depth/{DEPTHS[1]:.6f}.png"]
    tables = [f"{name}/{table}.txt" for table in ("rgb", "depth", "groundtruth")]
    return Layout(
        reader,
        name,
        lambda root, written: write_sequence(root / name, written),
        names=NAMES,
        image=files[0],
        depth=files[1],
        needed=(*files, *tables),
        tables=tables,
        views=views,
        depth_error=0.51 * STEP,
        damages=(
            *((f"{table}: expected lines", written(table, "# nothing\n")) for table in tables),
            (rf"rgb/{NAMES[2]}\.png: no such file, but rgb\.txt lists it", removed(f"{name}/rgb/{NAMES[2]}.png")),
            (r"rgb\.txt, line 7: expected 'time file'", relined(tables[0], lambda lines: [*lines, "1305031102.0"])),
            (r"rgb\.txt, line 7: expected numbers", relined(tables[0], lambda lines: [*lines, "noon rgb/a.png"])),
            (r"rgb\.txt, line 7: .* is listed twice", relined(tables[0], lambda lines: [*lines, "1" + lines[1][17:]])),
            (
                r"groundtruth\.txt, line 43: expected 8 numbers, got 4",
                relined(tables[2], lambda lines: [*lines, "1305031102.0 1 2 3"]),
            ),
        ),
    )


LAYOUTS = (_layout(TUM, TUM_NAME, TUM_VIEWS), _layout(Bonn, BONN_NAME, BONN_VIEWS))
