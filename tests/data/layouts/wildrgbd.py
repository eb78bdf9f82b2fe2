"""WildRGB-D: portrait pictures, millimetres, intrinsics column by column, numbered lines of poses."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from analytic_room import pinhole
from room_views import RoomView, millimetres, room_views, write_image

from layouts.layout import Layout, relined, written
from logvggt_jax.data.readers.wildrgbd import WildRGBD

SIZE = (64, 48)
INTRINSICS = np.array([[52.0, 0, 22.5], [0, 53.0, 33.0], [0, 0, 1]])
SCENE = "apple/scenes/scene_007"


def write_metadata(scene: Path, intrinsics: np.ndarray, size: tuple[int, int] = SIZE) -> None:
    (scene / "metadata").write_text(
        json.dumps({"w": size[1], "h": size[0], "K": intrinsics.T.ravel().tolist(), "fps": 30})
    )


def write(root: Path, views: Sequence[RoomView]) -> None:
    scene = root / SCENE
    lines = []
    for index, seen in enumerate(views):
        write_image(scene / f"rgb/{index:05d}.png", seen.picture)
        write_image(scene / f"depth/{index:05d}.png", millimetres(seen.depth))
        lines.append(" ".join([str(index), *(f"{value:.9g}" for value in seen.pose.ravel())]))
    (scene / "masks").mkdir()
    (scene / "cam_poses.txt").write_text("\n".join(lines) + "\n")
    write_metadata(scene, INTRINSICS)
    (root / "apple" / "types.json").write_text("{}")


FILES = [f"{SCENE}/{name}" for name in ("rgb/00001.png", "depth/00001.png", "metadata", "cam_poses.txt")]
LAYOUT = Layout(
    WildRGBD,
    "apple/scene_007",
    write,
    names=[f"{index:05d}" for index in range(4)],
    image=FILES[0],
    depth=FILES[1],
    needed=FILES,
    tables=FILES[2:],
    views=room_views(4, INTRINSICS, SIZE),
    depth_error=0.00051,
    damages=(
        *(
            (
                rf"cam_poses\.txt, line 2: .*{complaint}",
                relined(FILES[3], lambda lines, text=text: [lines[0], text, *lines[2:]]),
            )
            for text, complaint in (
                ("1 0 0 0", "expected 17 numbers, got 4"),
                ("1.5 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "frame number: expected a whole number, got 1\\.5"),
                ("1 1 0 0 0 0 -1 0 0 0 0 1 0 0 0 0 1", "rigid"),
            )
        ),
        *(
            (r"scene_007/metadata: .*fetch it again", written(FILES[2], text))
            for text in (
                "",
                "[]",
                '{"w": 4, "h": 3}',
                '{"w": 4, "h": 3, "K": [1, 2]}',
                '{"w": 0, "h": 3, "K": [1,0,0,0,1,0,0,0,1]}',
            )
        ),
        # Row by row, and a focal length of a million pixels.
        (r"metadata: intrinsics", lambda root: write_metadata(root / SCENE, INTRINSICS.T)),
        (r"metadata: intrinsics fx=1e\+06", lambda root: write_metadata(root / SCENE, pinhole(SIZE, 1e6))),
    ),
)
