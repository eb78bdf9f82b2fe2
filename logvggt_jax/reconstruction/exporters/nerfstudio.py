"""nerfstudio's `transforms.json`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from logvggt_jax.data.formats.calibration import OPENGL_AXES
from logvggt_jax.data.formats.nerfstudio_transforms import TRANSFORMS_FILE
from logvggt_jax.files import write_text
from logvggt_jax.geometry import invert
from logvggt_jax.reconstruction.exporters.frame_names import file_stems
from logvggt_jax.reconstruction.exporters.picture_masks import write_masks
from logvggt_jax.reconstruction.exporters.pictures import Pictures
from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.exporters.tracks import NUM_POINTS
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

_POINTS = "points.ply"


def export_nerfstudio(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Fills a folder with `transforms.json`, `images/`, `points.ply`, and where the result has masks `masks/`, black
    where nothing is to be seen.

    Cameras are camera-to-world with OpenGL axes, in the world of the points; the centre of the first pixel is at
    (0.5, 0.5). Where all frames have one lens the file has it once for all besides: some readers look nowhere else, and
    nerfstudio takes it for every frame. `point_filter` None gives 100,000 points.
    """
    pictures = Pictures.of(result)
    height, width = pictures.size
    stems = file_stems(result.names)
    files = pictures.write(path / "images", stems, progress=progress)
    masks: list[dict[str, str]] = [{}] * len(files)
    if result.masked.any():
        write_masks(result, path / "masks", [f"{stem}.png" for stem in stems], pictures.size)
        masks = [{"mask_path": f"masks/{stem}.png"} for stem in stems]
    poses = np.asarray(invert(result.extrinsics)) @ OPENGL_AXES
    lenses = [
        {
            "fl_x": matrix[0, 0],
            "fl_y": matrix[1, 1],
            "cx": matrix[0, 2] + 0.5,
            "cy": matrix[1, 2] + 0.5,
            "w": width,
            "h": height,
        }
        for matrix in pictures.intrinsics
    ]
    frames = [
        {"file_path": f"images/{file}", **mask, **lens, "transform_matrix": pose.tolist()}
        for file, mask, lens, pose in zip(files, masks, lenses, poses, strict=True)
    ]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    export_ply(result, path / _POINTS, point_filter=point_filter or result.filtered(NUM_POINTS), progress=progress)
    document = {"camera_model": "OPENCV", **shared, "ply_file_path": _POINTS, "frames": frames}
    write_text(path / TRANSFORMS_FILE, json.dumps(document, indent=1) + "\n")
