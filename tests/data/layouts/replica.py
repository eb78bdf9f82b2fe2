"""Replica as NICE-SLAM renders it: JPEG, 16-bit depth, one line a pose, one camera for all scenes."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import CENTRE, FOCAL, SIZE, RoomView, write_image

from layouts.layout import Layout, changed, relined, removed, written
from logvggt_jax.data.readers.replica import Replica

SCALE = 6553.5
CAMERA = {"w": SIZE[1], "h": SIZE[0], "fx": FOCAL, "fy": FOCAL, "cx": CENTRE[0], "cy": CENTRE[1], "scale": SCALE}


def write_camera(root: Path, **changes: object) -> None:
    root.mkdir(parents=True, exist_ok=True)
    (root / "cam_params.json").write_text(json.dumps({"camera": CAMERA | changes}))


def write_scene(folder: Path, views: Sequence[RoomView]) -> None:
    for index, each in enumerate(views):
        write_image(folder / f"results/frame{index:06d}.jpg", each.picture)
        write_image(folder / f"results/depth{index:06d}.png", np.rint(each.depth * SCALE).astype(np.uint16))
    np.savetxt(folder / "traj.txt", [each.pose.ravel() for each in views])


def write(root: Path, views: Sequence[RoomView]) -> None:
    write_camera(root)
    write_scene(root / "room0", views)


LAYOUT = Layout(
    Replica,
    "room0",
    write,
    names=[f"frame{index:06d}" for index in range(4)],
    image="room0/results/frame000001.jpg",
    depth="room0/results/depth000001.png",
    needed=("room0/results/frame000001.jpg", "room0/results/depth000001.png", "room0/traj.txt"),
    tables=("room0/traj.txt", "cam_params.json"),
    depth_error=0.51 / SCALE,
    picture_error=2.0,
    damages=(
        (r"traj\.txt: expected 4 poses.*got 5 lines", relined("room0/traj.txt", lambda lines: [*lines, lines[0]])),
        (
            r"traj\.txt, line 1: expected 16 numbers, got 17",
            changed("room0/traj.txt", lambda data: data.replace(b" ", b" 7 ", 1)),
        ),
        (
            "results: frame 1 is missing",
            removed("room0/results/frame000001.jpg", "room0/results/depth000001.png"),
        ),
        (r"cam_params\.json.*expected", written("cam_params.json", "[1]")),
        (r"cam_params\.json.*expected.*'h'", written("cam_params.json", '{"camera": {"w": 64}}')),
        (r"cam_params\.json.*must be from 1 to", lambda root: write_camera(root, scale=0)),
        (r"cam_params\.json.*expected.*wide", lambda root: write_camera(root, fx="wide")),
        (r"cam_params\.json: intrinsics.*cannot belong", lambda root: write_camera(root, cx=500.0)),
    ),
)
