"""ScanNet: the export of its SensReader, and the form that published evaluations prepare from it."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from room_views import INTRINSICS, RoomView, millimetres, write_image

from layouts.layout import VIEWS, Layout, written
from logvggt_jax.data.readers.scannet import ScanNet

COLOUR_SIZE = (97, 130)
NUMBERS = (8, 9, 10, 11)
SCENE = "scans_train/scene0000_00"


def write_pictures(each: RoomView, image: Path, depth: Path) -> None:
    write_image(image, cv2.resize(each.picture, COLOUR_SIZE[::-1], interpolation=cv2.INTER_CUBIC))
    write_image(depth, millimetres(each.depth))


def write_intrinsics(scene: Path) -> None:
    (scene / "intrinsic").mkdir(parents=True)
    for name, factor in (("depth", 1.0), ("color", 2.03)):
        padded = np.eye(4)
        padded[:3, :3] = INTRINSICS * factor
        np.savetxt(scene / "intrinsic" / f"intrinsic_{name}.txt", padded)
        np.savetxt(scene / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4))


def write_scene(scene: Path, views: Sequence[RoomView] = VIEWS) -> None:
    write_intrinsics(scene)
    (scene / "pose").mkdir()
    for number, each in zip(NUMBERS, views, strict=False):
        write_pictures(each, scene / f"color/{number}.jpg", scene / f"depth/{number}.png")
        # Lost tracking is -inf in the export.
        np.savetxt(scene / f"pose/{number}.txt", np.nan_to_num(each.pose, nan=-np.inf))


def write_prepared(scene: Path, views: Sequence[RoomView] = VIEWS, count: int = 90) -> None:
    write_intrinsics(scene)
    for index, each in enumerate(views):
        name = f"frame_{index:04d}"
        write_pictures(each, scene / f"color_{count}/{name}.jpg", scene / f"depth_{count}/{name}.png")
    np.savetxt(scene / f"pose_{count}.txt", [each.pose.ravel() for each in views])


def write(root: Path, views: Sequence[RoomView]) -> None:
    write_scene(root / SCENE, views)


TABLES = (f"{SCENE}/pose/9.txt", f"{SCENE}/intrinsic/intrinsic_depth.txt")
LAYOUT = Layout(
    ScanNet,
    "scene0000_00",
    write,
    names=[str(number) for number in NUMBERS],
    image=f"{SCENE}/color/9.jpg",
    depth=f"{SCENE}/depth/9.png",
    needed=(f"{SCENE}/color/9.jpg", f"{SCENE}/depth/9.png", *TABLES),
    tables=TABLES,
    depth_error=0.00051,
    picture_error=3.0,
    damages=(
        (
            r"depth/9\.png: 64 x 48 has another aspect ratio than 48 x 64",
            lambda root: write_image(root / f"{SCENE}/color/9.jpg", np.zeros((64, 48, 3), np.uint8)),
        ),
        (r"pose/9\.txt: expected 16 numbers, got 12", written(TABLES[0], "1 0 0 0\n" * 3)),
        (
            r"scannetv2/scene0000_00 and .*scans_train/scene0000_00 are the same",
            lambda root: write_scene(root / "scannetv2/scene0000_00"),
        ),
    ),
)
