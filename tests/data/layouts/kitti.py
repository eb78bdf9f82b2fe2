"""KITTI depth: sparse depth of a part of the pictures, a calibration a day, no poses."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from room_views import INTRINSICS, SIZE, RoomView, write_image

from layouts.layout import VIEWS, Layout, written
from logvggt_jax.data.readers.kitti import KITTI

DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0002_sync"
NUMBERS = (5, 6, 7, 8)
MEASURED = [np.random.default_rng(index).random(SIZE) < 0.2 for index in range(len(NUMBERS))]
SPARSE = [replace(each, depth=np.where(there, each.depth, 0.0)) for each, there in zip(VIEWS, MEASURED, strict=True)]
IMAGES, DEPTHS = f"{DATE}/{DRIVE}/image_02/data", f"val/{DRIVE}/proj_depth/groundtruth/image_02"


def calibration() -> str:
    def line(name: str, matrix: np.ndarray) -> str:
        return f"{name}: " + " ".join(f"{value:.6e}" for value in matrix.ravel())

    projection = np.hstack([INTRINSICS, [[4.485728], [0.2163791], [0.002745884]]])
    other = projection * [[2.0], [2.0], [1.0]]
    named = {"K_02": INTRINSICS * 1.3, "P_rect_00": other, "P_rect_02": projection, "P_rect_03": other}
    return "\n".join(["calib_time: 09-Jan-2012 13:57:47", *(line(*item) for item in named.items())])


def write_frames(images: Path, depths: Path, views: Sequence[RoomView] = SPARSE) -> None:
    for number, each in zip(NUMBERS, views, strict=True):
        write_image(images / f"{number:010d}.png", each.picture)
        write_image(depths / f"{number:010d}.png", np.rint(each.depth * 256).astype(np.uint16))


def write_calibration(root: Path, date: str = DATE) -> None:
    (root / date).mkdir(parents=True, exist_ok=True)
    (root / date / "calib_cam_to_cam.txt").write_text(calibration())


def write(root: Path, views: Sequence[RoomView] = SPARSE, drive: str = DRIVE, part: str = "val") -> None:
    date = drive[:10]
    write_frames(root / date / drive / "image_02/data", root / part / drive / "proj_depth/groundtruth/image_02", views)
    write_calibration(root, date)


CALIBRATION = f"{DATE}/calib_cam_to_cam.txt"
LAYOUT = Layout(
    KITTI,
    DRIVE,
    write,
    names=[f"{number:010d}" for number in NUMBERS],
    image=f"{IMAGES}/0000000006.png",
    depth=f"{DEPTHS}/0000000006.png",
    needed=(f"{IMAGES}/0000000006.png", IMAGES, DEPTHS, CALIBRATION),
    tables=(CALIBRATION,),
    views=SPARSE,
    depth_error=0.501 / 256,
    poses="none",
    damages=(
        (
            r"image_02/0000000006\.png: expected 16-bit depth",
            lambda root: write_image(root / f"{DEPTHS}/0000000006.png", np.zeros(SIZE, np.uint8)),
        ),
        (r"calib_cam_to_cam\.txt, P_rect_02: expected 12 numbers, got 3", written(CALIBRATION, "P_rect_02: 1 2 3\n")),
        (r"calib_cam_to_cam\.txt: no line P_rect_02", written(CALIBRATION, "P_rect_00: 1 2 3\n")),
    ),
)
