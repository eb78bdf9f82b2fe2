"""MVS-Synth: EXR depth, JSON cameras, a left-handed world, ten units a metre."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR
from room_views import CENTRE, FOCAL, RoomView, write_image

from layouts.layout import Layout
from logvggt_jax.data.readers.mvs_synth import MVSSynth

# The game's world has x and y swapped, so that it is left-handed.
SWAP = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
UNIT = 10.0


def write_exr(path: Path, depth: np.ndarray, channel: str = "Y") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {channel: depth}) as file:
        file.write(str(path))


def write_pose(path: Path, extrinsic: np.ndarray, **changes: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = {"f_x": FOCAL, "f_y": FOCAL, "c_x": CENTRE[0], "c_y": CENTRE[1], "extrinsic": extrinsic.tolist()}
    path.write_text(json.dumps(camera | changes))


def write(root: Path, views: Sequence[RoomView]) -> None:
    folder = root / "GTAV_720" / "0000"
    for index, each in enumerate(views):
        write_image(folder / f"images/{index:04d}.png", each.picture)
        write_exr(folder / f"depths/{index:04d}.exr", (UNIT * each.depth).astype(np.float32))
        stored = each.extrinsics @ SWAP
        stored[:3, 3] *= UNIT
        write_pose(folder / f"poses/{index:04d}.json", stored)
    (root / "GTAV_720" / "num_images.json").write_text("[3]")


FILES = [f"GTAV_720/0000/{name}" for name in ("images/0001.png", "depths/0001.exr", "poses/0001.json")]
LAYOUT = Layout(
    MVSSynth,
    "0000",
    write,
    names=[f"{index:04d}" for index in range(4)],
    image=FILES[0],
    depth=FILES[1],
    needed=FILES,
    tables=(FILES[2],),
    unit=UNIT,
)
