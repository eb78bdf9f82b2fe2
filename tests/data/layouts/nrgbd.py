"""Neural RGB-D: unpadded names, millimetres, OpenGL cameras in four lines a frame, one focal length for 640 x 480."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from analytic_room import pinhole
from room_views import SIZE, RoomView, millimetres, room_views, write_image

from layouts.layout import Layout
from logvggt_jax.data.readers.nrgbd import NRGBD

FOCAL = 554.2562584220408
INTRINSICS = pinhole(SIZE, FOCAL / 10, (31.55, 23.55))


def write(root: Path, views: Sequence[RoomView]) -> None:
    folder = root / "kitchen"
    for index, each in enumerate(views):
        write_image(folder / f"images/img{index}.png", each.picture)
        write_image(folder / f"depth/depth{index}.png", millimetres(each.depth))
        write_image(folder / f"depth_filtered/depth{index}.png", np.ones(SIZE, np.uint16))
    opengl = np.diag([1, -1, -1, 1])
    np.savetxt(folder / "poses.txt", np.concatenate([each.pose @ opengl for each in views]))
    (folder / "trainval_poses.txt").write_text("nan nan nan nan\n" * 4 * len(views))
    (folder / "focal.txt").write_text(f"{FOCAL}\n")


LAYOUT = Layout(
    NRGBD,
    "kitchen",
    write,
    names=[f"img{index}" for index in range(12)],
    image="kitchen/images/img1.png",
    depth="kitchen/depth/depth1.png",
    needed=[f"kitchen/{name}" for name in ("images/img1.png", "depth/depth1.png", "poses.txt", "focal.txt")],
    tables=("kitchen/poses.txt", "kitchen/focal.txt"),
    views=room_views(12, INTRINSICS),
    depth_error=0.00051,
)
