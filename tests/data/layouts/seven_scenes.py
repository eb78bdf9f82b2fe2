"""7-Scenes with depth that is projected into the colour camera, one text file a pose."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from analytic_room import pinhole
from room_views import SIZE, RoomView, millimetres, room_views, write_image

from layouts.layout import Layout, removed
from logvggt_jax.data.readers.seven_scenes import SevenScenes

INTRINSICS = pinhole(SIZE, 52.5, (31.55, 23.55))


def write(root: Path, views: Sequence[RoomView]) -> None:
    folder = root / "den/seq-01"
    for index, each in enumerate(views):
        stem = folder / f"frame-{index:06d}"
        write_image(stem.with_suffix(".color.png"), each.picture)
        write_image(stem.with_suffix(".depth.proj.png"), millimetres(each.depth))
        np.savetxt(stem.with_suffix(".pose.txt"), each.pose)


FILES = [f"den/seq-01/frame-000001.{kind}" for kind in ("color.png", "depth.proj.png", "pose.txt")]
LAYOUT = Layout(
    SevenScenes,
    "den/seq-01",
    write,
    names=[f"frame-{index:06d}" for index in range(4)],
    image=FILES[0],
    depth=FILES[1],
    needed=(FILES[0], FILES[2]),
    tables=(FILES[2],),
    views=room_views(4, INTRINSICS),
    depth_error=0.00051,
    damages=(
        (r"frame-000001\.depth\.png: no such file, but frame", removed(FILES[1])),
        (r"frame-000001\.depth\.proj\.png.*uint8", lambda root: write_image(root / FILES[1], np.zeros(SIZE, np.uint8))),
        (
            r"frame-000001\.color\.png.*\(24, 32\)",
            lambda root: [
                write_image(root / FILES[0], np.zeros((24, 32, 3), np.uint8)),
                write_image(root / FILES[1], np.zeros((24, 32), np.uint16)),
            ],
        ),
        ("side by side", lambda root: (root / "seq-01").mkdir()),
        ("seq-01: no files like", lambda root: [path.unlink() for path in (root / "den/seq-01").iterdir()]),
    ),
)
