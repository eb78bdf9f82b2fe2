"""nerfstudio's form: one `transforms.json` with cameras in OpenGL's axes, pictures and depth as it names them."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import INTRINSICS, SIZE, RoomView, millimetres, write_image

from layouts.layout import Layout, changed, removed, written
from logvggt_jax.data.readers.nerfstudio import Nerfstudio

NAME = "hallway"
NAMES = tuple(f"images/frame_{number}.png" for number in (8, 9, 10, 11))
TABLE = f"{NAME}/transforms.json"


def content(views: Sequence[RoomView]) -> dict:
    """What `transforms.json` says; the first pixel's centre is at (0.5, 0.5)."""
    height, width = SIZE
    frames = [
        {
            "file_path": f"./{name}",
            "depth_file_path": name.replace("images", "depth"),
            "transform_matrix": (each.pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for name, each in zip(NAMES, views, strict=True)
    ]
    return {
        "camera_model": "OPENCV",
        "w": width,
        "h": height,
        "fl_x": INTRINSICS[0, 0],
        "fl_y": INTRINSICS[1, 1],
        "cx": INTRINSICS[0, 2] + 0.5,
        "cy": INTRINSICS[1, 2] + 0.5,
        "k1": 0.0,
        "frames": frames[::-1],
    }


def write(root: Path, views: Sequence[RoomView]) -> None:
    folder = root / NAME
    for name, each in zip(NAMES, views, strict=True):
        write_image(folder / name, each.picture)
        write_image(folder / name.replace("images", "depth"), millimetres(each.depth))
    (folder / "transforms.json").write_text(json.dumps(content(views)))


LAYOUT = Layout(
    Nerfstudio,
    NAME,
    write,
    names=NAMES,
    image=f"{NAME}/{NAMES[1]}",
    depth=f"{NAME}/depth/frame_9.png",
    needed=(f"{NAME}/{NAMES[1]}", f"{NAME}/depth/frame_9.png"),
    tables=(TABLE,),
    depth_error=0.00051,
    damages=(
        (r"transforms\.json: not JSON", written(TABLE, '{"frames": [')),
        (r"transforms\.json: expected an object with a list", written(TABLE, '{"w": 3}')),
        (r"frames\[3\]: OPENCV with distortion", changed(TABLE, lambda x: x.replace(b'"k1": 0.0', b'"k4": 0.1'))),
        (r"frames\[3\]: OPENCV with distortion", changed(TABLE, lambda x: x.replace(b'"k1": 0.0', b'"k1": NaN'))),
        (r"frames\[3\]: FOV with distortion", changed(TABLE, lambda x: x.replace(b'"OPENCV"', b'"FOV"'))),
        (r"json: nothing of frame_\d+\.png", changed(TABLE, lambda x: x.replace(b'"k1": 0.0', b'"k1": -1e300'))),
        (r"frames\[3\]: no fl_y", changed(TABLE, lambda x: x.replace(b'"fl_y"', b'"fl"'))),
        (
            r"'\.\./frame_9\.png' is no file's name",
            changed(TABLE, lambda x: x.replace(b"./images/frame_9", b"../frame_9")),
        ),
        (
            r"images/frame_7\.png: no such file, but .*json names it",
            changed(TABLE, lambda x: x.replace(b"./images/frame_9", b"images/frame_7")),
        ),
        (r"frames\[3\].*matrix of 1 x 4", changed(TABLE, lambda x: x[: x.rindex(b"[[")] + b"[1, 2, 3, 4]}]}")),
        (r"frame_9\.png: no such file", removed(f"{NAME}/{NAMES[1]}")),
    ),
)
