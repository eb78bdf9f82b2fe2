"""KITTI odometry: poses of camera 0, pictures of camera 2, depth in the form of KITTI's depth benchmark."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import INTRINSICS, RoomView, write_image

from layouts.layout import VIEWS, Layout, relined, written
from logvggt_jax.data.readers.kitti_odometry import KITTIOdometry

# Camera 2 has its point of view 6 cm to the left of camera 0's, and a little elsewhere.
SHIFT = np.array([0.06, -0.001, 0.003])
FROM_CAMERA_0 = np.eye(4)
FROM_CAMERA_0[:3, 3] = SHIFT


def calibration(intrinsics: np.ndarray = INTRINSICS) -> str:
    def line(name: str, shift: np.ndarray) -> str:
        matrix = np.hstack([intrinsics, (intrinsics @ shift)[:, None]])
        return f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.ravel())

    shifts = {"P0": 0 * SHIFT, "P1": -SHIFT, "P2": SHIFT, "P3": 3 * SHIFT}
    return "\n".join([*(line(*item) for item in shifts.items()), "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0"])


def write(root: Path, views: Sequence[RoomView], *, depth: bool = True, name: str = "00") -> None:
    folder = root / "sequences" / name
    for number, each in enumerate(views):
        write_image(folder / f"image_2/{number:06d}.png", each.picture)
        if depth:
            write_image(folder / f"depth_2/{number:06d}.png", np.rint(each.depth * 256).astype(np.uint16))
    (folder / "calib.txt").write_text(calibration())
    (root / "poses").mkdir(exist_ok=True)
    np.savetxt(root / f"poses/{name}.txt", [(each.pose @ FROM_CAMERA_0)[:3].ravel() for each in views])


IMAGE, DEPTH = "sequences/00/image_2/000001.png", "sequences/00/depth_2/000001.png"
TABLES = ("sequences/00/calib.txt", "poses/00.txt")
LAYOUT = Layout(
    KITTIOdometry,
    "00",
    write,
    names=[f"{number:06d}" for number in range(len(VIEWS))],
    image=IMAGE,
    depth=DEPTH,
    needed=("sequences/00/image_2", *TABLES),
    tables=TABLES,
    depth_error=0.501 / 256,
    damages=(
        (r"calib\.txt: no line P2", written(TABLES[0], "P0: 1 2 3\n")),
        (r"calib\.txt, P2: expected 12 numbers, got 3", written(TABLES[0], "P2: 1 2 3\n")),
        (r"calib\.txt, P2: .*expected intrinsics", written(TABLES[0], f"P2:{' 0' * 12}\n")),
        (r"poses/00\.txt: expected 4 poses of 1 lines for 4 pictures, got 3", relined(TABLES[1], lambda x: x[1:])),
        (r"image_2: frame 1 is missing", lambda root: (root / IMAGE).unlink()),
    ),
)
