"""PointOdyssey v1.2: 16-bit depth up to 1000 m, cameras in an npz file beside large point tracks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from room_views import RoomView, write_image

from layouts.layout import VIEWS, Layout
from logvggt_jax.data.readers.pointodyssey import PointOdyssey

STEP = 1000 / 65535


def write_cameras(folder: Path, views: Sequence[RoomView] = VIEWS, **changes: np.ndarray | None) -> None:
    count = len(views)
    arrays: dict[str, np.ndarray | None] = {
        "trajs_2d": np.zeros((count, 5, 2), np.float32),
        "trajs_3d": np.zeros((count, 5, 3), np.float32),
        "visibs": np.ones((count, 5), bool),
        "valids": np.ones((count, 5), bool),
        "intrinsics": np.stack([each.intrinsics for each in views]).astype(np.float32),
        "extrinsics": np.stack([each.extrinsics for each in views]).astype(np.float32),
    }
    np.savez(folder / "anno.npz", **{name: array for name, array in (arrays | changes).items() if array is not None})


def write_sequence(folder: Path, views: Sequence[RoomView] = VIEWS) -> None:
    for index, each in enumerate(views):
        write_image(folder / f"rgbs/rgb_{index:05d}.jpg", each.picture)
        write_image(folder / f"depths/depth_{index:05d}.png", np.rint(each.depth / STEP).astype(np.uint16))
        write_image(folder / f"masks/mask_{index:05d}.png", each.picture)
    write_cameras(folder, views)


def write(root: Path, views: Sequence[RoomView]) -> None:
    write_sequence(root / "train/dancing", views)


FILES = [f"train/dancing/{name}" for name in ("rgbs/rgb_00001.jpg", "depths/depth_00001.png", "anno.npz")]
LAYOUT = Layout(
    PointOdyssey,
    "train/dancing",
    write,
    names=[f"rgb_{index:05d}" for index in range(4)],
    image=FILES[0],
    depth=FILES[1],
    needed=FILES,
    tables=(FILES[2],),
    depth_error=0.51 * STEP,
    picture_error=2.0,
)
