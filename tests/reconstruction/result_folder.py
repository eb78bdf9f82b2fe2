"""A small result folder, written without a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from logvggt_jax.reconstruction.cameras_file import write_cameras
from logvggt_jax.reconstruction.depth_files import write_depth, write_picture
from logvggt_jax.reconstruction.points.cloud_file import VERTEX, write_points

SIZE = (24, 32)


def write_result(folder: Path, count: int = 3) -> None:
    """Frames 0, 1, … whose cameras look along z from x = 0, 1, …; depth is 2 everywhere, the cloud ten points."""
    extrinsics = np.tile(np.eye(4)[:3], (count, 1, 1))
    extrinsics[:, 0, 3] = -np.arange(count)
    intrinsics = np.tile(np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (count, 1, 1))
    names = [str(index) for index in range(count)]
    write_cameras(
        folder / "cameras.json",
        names=names,
        timestamps=list(range(count)),
        extrinsics=extrinsics,
        intrinsics=intrinsics,
        image_size=(48, 64),
        model_intrinsics=np.diag([0.5, 0.5, 1.0]) @ intrinsics,
        model_size=SIZE,
    )
    (folder / "depth").mkdir()
    (folder / "images").mkdir()
    for index, name in enumerate(names):
        write_depth(folder / "depth" / f"{name}.npz", np.full(SIZE, 2.0), np.full(SIZE, 1.0 + index))
        write_picture(folder / "images" / f"{name}.jpg", np.full((*SIZE, 3), 40 * index, np.uint8))
    vertices = np.zeros(10, VERTEX)
    vertices["z"] = np.arange(10)
    write_points(folder / "points.ply", 10, [vertices])
