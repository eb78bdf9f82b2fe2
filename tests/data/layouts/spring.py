"""Spring: stereo disparity of twice the picture's size in HDF5, rows of numbers for the cameras."""

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from room_views import FOCAL, RoomView, pinhole_row, write_image

from layouts.layout import Layout, relined
from logvggt_jax.data.readers.spring import Spring

BASELINE = 0.065


def write_disparity(path: Path, disparity: np.ndarray, name: str = "disparity") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=disparity, compression="gzip")


def write(root: Path, views: Sequence[RoomView]) -> None:
    """Of the four values of disparity for each pixel the first is the pixel's own."""
    folder = root / "train/0001"
    for number, each in enumerate(views, 1):
        write_image(folder / f"frame_left/frame_left_{number:04d}.png", each.picture)
        disparity = np.zeros((2 * each.depth.shape[0], 2 * each.depth.shape[1]), np.float32)
        disparity[::2, ::2] = np.divide(FOCAL * BASELINE, each.depth, out=0 * each.depth, where=each.depth > 0)
        write_disparity(folder / f"disp1_left/disp1_left_{number:04d}.dsp5", disparity)
    (folder / "cam_data").mkdir()
    np.savetxt(folder / "cam_data/intrinsics.txt", [pinhole_row(each) for each in views])
    np.savetxt(folder / "cam_data/extrinsics.txt", [each.extrinsics.ravel() for each in views])
    np.savetxt(folder / "cam_data/focaldistance.txt", [[1.0]] * len(views))


FILES = ("train/0001/frame_left/frame_left_0002.png", "train/0001/disp1_left/disp1_left_0002.dsp5")
TABLES = ("train/0001/cam_data/intrinsics.txt", "train/0001/cam_data/extrinsics.txt")
LAYOUT = Layout(
    Spring,
    "0001",
    write,
    names=[f"frame_left_{number:04d}" for number in range(1, 5)],
    image=FILES[0],
    depth=FILES[1],
    needed=(*FILES, *TABLES),
    tables=TABLES,
    damages=(
        *(
            (
                f"{name}: expected a row for each of the frames 1 to 4, got 2 rows",
                relined(name, lambda lines: lines[:2]),
            )
            for name in TABLES
        ),
        *(
            (
                f"{name}, row 2: expected (4|16) numbers, got (5|17)",
                relined(name, lambda lines: [lines[0], lines[1] + " 1", *lines[2:]]),
            )
            for name in TABLES
        ),
        (
            r"disp1_left_0002\.dsp5: expected numbers of shape 96 x 128.*\(48, 64\)",
            lambda root: write_disparity(root / FILES[1], np.ones((48, 64), np.float32)),
        ),
        (
            r"disp1_left_0002\.dsp5: no array 'disparity', only flow",
            lambda root: write_disparity(root / FILES[1], np.ones((96, 128), np.float32), name="flow"),
        ),
        ("train: no such folder", lambda root: (root / "train").rename(root / "spring_train")),
    ),
)
