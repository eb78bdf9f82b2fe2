"""MVS-Synth: EXR depth, JSON cameras, a left-handed world, ten units a metre."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR
from room_views import CENTRE, FOCAL, RoomView, pinhole_row, write_image

from layouts.layout import Layout, changed, written
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
        camera = dict(zip(("f_x", "f_y", "c_x", "c_y"), pinhole_row(each), strict=True))
        write_pose(folder / f"poses/{index:04d}.json", stored, **camera)
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
    damages=(
        (r"0001\.json.*left-handed.*\+1", lambda root: write_pose(root / FILES[2], np.eye(4))),
        # Only the size 720 is read.
        ("GTAV_720", lambda root: (root / "GTAV_720").rename(root / "GTAV_540")),
        (r"0001\.exr: truncated or damaged", changed(FILES[1], lambda data: data[:900] + b"\xff" * 200)),
        (
            r"0001\.exr: expected one part with one channel, got 1 with B, G, R",
            lambda root: write_exr(root / FILES[1], np.zeros((48, 64, 3), np.float32), "RGB"),
        ),
        (
            r"0001\.exr: expected half or float pixels, got uint32",
            lambda root: write_exr(root / FILES[1], np.zeros((48, 64), np.uint32)),
        ),
        (r"0001\.json.*TypeError", written(FILES[2], "[]")),
        (r"0001\.json.*f_x", written(FILES[2], '{"extrinsic": [[1]]}')),
        (
            r"0001\.json.*4 x 4 numbers, got \(1, 1\)",
            written(FILES[2], '{"extrinsic": [[1]], "f_x": 1, "f_y": 1, "c_x": 1, "c_y": 1}'),
        ),
        (
            r"0001\.json: intrinsics .* cannot belong to a picture of 64 x 48, as 0001\.png is",
            lambda root: write_pose(root / FILES[2], SWAP, c_x=960.0, c_y=540.0),
        ),
    ),
)
