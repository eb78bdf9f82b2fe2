"""Virtual KITTI 2: two cameras whose rows are interleaved in text files, depth in centimetres."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import RoomView, pinhole_row, room_views, write_image

from layouts.layout import VIEWS, Layout, changed, relined
from logvggt_jax.data.readers.virtual_kitti import VirtualKITTI

BASELINE = 0.532725
RIGHT = room_views(4, shift=BASELINE)


def write_variation(folder: Path, left: Sequence[RoomView] = VIEWS, right: Sequence[RoomView] = RIGHT) -> None:
    intrinsic = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    extrinsic = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"]
    for frame, pair in enumerate(zip(left, right, strict=True)):
        for camera, each in enumerate(pair):
            write_image(folder / f"frames/rgb/Camera_{camera}/rgb_{frame:05d}.jpg", each.picture)
            depth = np.rint(100 * each.depth).astype(np.uint16)
            write_image(folder / f"frames/depth/Camera_{camera}/depth_{frame:05d}.png", depth)
            intrinsic.append(f"{frame} {camera} " + " ".join(map(str, pinhole_row(each))))
            extrinsic.append(f"{frame} {camera} " + " ".join(map(str, each.extrinsics.ravel())))
    (folder / "intrinsic.txt").write_text("\n".join(intrinsic) + "\n")
    (folder / "extrinsic.txt").write_text("\n".join(extrinsic) + "\n")


def write(root: Path, views: Sequence[RoomView]) -> None:
    write_variation(root / "Scene01/clone", left=VIEWS, right=views)


FILES = [f"Scene01/clone/frames/{name}" for name in ("rgb/Camera_1/rgb_00001.jpg", "depth/Camera_1/depth_00001.png")]
TABLES = ("Scene01/clone/intrinsic.txt", "Scene01/clone/extrinsic.txt")
LAYOUT = Layout(
    VirtualKITTI,
    "Scene01/clone/Camera_1",
    write,
    names=[f"rgb_{index:05d}" for index in range(4)],
    image=FILES[0],
    depth=FILES[1],
    needed=(*FILES, *TABLES),
    tables=TABLES,
    views=RIGHT,
    depth_error=0.0051,
    picture_error=2.0,
    damages=(
        *(
            (f"{name}.*{complaint}", relined(name, change))
            for name in TABLES
            for complaint, change in (
                ("no row for frame 1 of Camera_1", lambda lines: [line for line in lines if line[:3] != "1 1"]),
                ("expected a header", lambda lines: lines[1:]),
                (
                    r"line 9: expected (6|18) numbers, got (5|17)",
                    lambda lines: [*lines[:-1], lines[-1].rpartition(" ")[0]],
                ),
                ("line 9: expected numbers", lambda lines: [*lines[:-1], lines[-1] + "x"]),
            )
        ),
        (
            r"intrinsic\.txt: intrinsics fx=0\.01 .* as rgb_00001\.jpg is",
            changed(TABLES[0], lambda data: data.replace(b"1 1 55.0", b"1 1 0.01")),
        ),
        (r"depth_00001\.png: expected 16-bit", lambda root: write_image(root / FILES[1], np.ones((48, 64), np.uint8))),
    ),
)
