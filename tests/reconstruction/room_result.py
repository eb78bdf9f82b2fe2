"""A result folder of a procedural room with exact cameras and depth, and the pictures it came from; without a model."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform, resize
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.frames import Frames
from logvggt_jax.reconstruction import PointFilter, Reconstruction, open_source
from logvggt_jax.reconstruction.cameras_file import write_cameras
from logvggt_jax.reconstruction.depth_files import depth_file, image_file, write_depth, write_picture
from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.result_folder import POINTS_FILE
from logvggt_jax.reconstruction.sources.record import record_source


def room_frames(size: tuple[int, int], count: int, **options: Any) -> Frames:
    """Neighbouring frames of a room."""
    rooms = Rooms("test", height=size[0], width=size[1], num_rooms=1, **options)
    return rooms.read(rooms.sequences[0], list(range(count)))


def write_room_result(
    folder: Path,
    *,
    count: int,
    size: tuple[int, int] = (42, 56),
    image_size: tuple[int, int] = (96, 128),
    metric: bool = True,
    source: bool = True,
    **options: Any,
) -> Reconstruction:
    """Writes `folder/source` (PNG files of `image_size`) and `folder/result`, whose depth has `size`; both (H, W).

    `options` are those of `Rooms`.
    """
    frames = room_frames(size, count, **options)
    pictures = frames if size == image_size else room_frames(image_size, count, **options)
    transform = ResizeTransform(image_size, size)
    result, originals = folder / "result", folder / "source"
    for made in (originals, result / "depth", result / "images"):
        made.mkdir(parents=True)
    names = [f"view {index}" for index in range(count)]
    for index, name in enumerate(names):
        write_picture(originals / f"{name}.png", pictures.images[index])
        write_depth(depth_file(result, name), frames.depth[index], np.full(size, 2.0))
        write_picture(image_file(result, name), resize(pictures.images[index], longer_edge=max(size))[0])
    intrinsics = frames.intrinsics.astype(np.float64)
    write_cameras(
        result / "cameras.json",
        names=names,
        timestamps=[index / 8 for index in range(count)],
        extrinsics=frames.extrinsics[:, :3].astype(np.float64),
        intrinsics=transform.intrinsics_to_original(intrinsics),
        image_size=image_size,
        model_intrinsics=intrinsics,
        model_size=size,
        source=record_source(open_source(originals), count) if source else None,
        metric=metric,
    )
    made = Reconstruction.with_cameras_of(result)
    export_ply(made, result / POINTS_FILE, point_filter=PointFilter(max_points=2000), progress=False)
    return Reconstruction.open(result)


def changed(
    result: Reconstruction, folder: Path, extrinsics: np.ndarray, growth: np.ndarray, focal: float = 1.0
) -> Reconstruction:
    """A copy of a result with other cameras and depth, its unit unknown."""
    shutil.copytree(result.folder, folder)
    zoom = np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])
    write_cameras(
        folder / "cameras.json",
        names=result.names,
        timestamps=result.timestamps.tolist(),
        extrinsics=extrinsics,
        intrinsics=zoom * result.intrinsics,
        image_size=result.image_size,
        model_intrinsics=zoom * result.depth_intrinsics,
        model_size=result.depth_size,
    )
    for index, name in enumerate(result.names):
        depth, confidence = result.depth_and_confidence(index)
        write_depth(depth_file(folder, name), growth[index] * depth, confidence)
    return Reconstruction.open(folder)
