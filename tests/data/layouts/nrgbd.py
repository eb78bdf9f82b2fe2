"""Neural RGB-D: unpadded names, millimetres, OpenGL cameras in four lines a frame, one focal length for 640 x 480."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from analytic_room import pinhole
from room_views import SIZE, RoomView, millimetres, room_views, write_image

from layouts.layout import Layout, relined, removed, written
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


POSES = "kitchen/poses.txt"
LAYOUT = Layout(
    NRGBD,
    "kitchen",
    write,
    names=[f"img{index}" for index in range(12)],
    image="kitchen/images/img1.png",
    depth="kitchen/depth/depth1.png",
    needed=[f"kitchen/{name}" for name in ("images/img1.png", "depth/depth1.png", "poses.txt", "focal.txt")],
    tables=(POSES, "kitchen/focal.txt"),
    views=room_views(12, INTRINSICS),
    depth_error=0.00051,
    damages=(
        (r"poses\.txt: expected 12 poses of 4 lines.*got 47 lines", relined(POSES, lambda lines: lines[:-1])),
        ("images: frame 5 is missing", removed("kitchen/images/img5.png", "kitchen/depth/depth5.png")),
        (r"focal\.txt: intrinsics fx=0\.55 .* as img0\.png is", written("kitchen/focal.txt", "5.5")),
        (r"focal\.txt: expected 1 numbers, got 2", written("kitchen/focal.txt", "554 554")),
        (
            r"poses\.txt, pose of img2\.png: not a rigid transform",
            relined(POSES, lambda lines: [*lines[:8], "-1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1", *lines[12:]]),
        ),
    ),
)
