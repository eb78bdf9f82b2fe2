"""Depth of every frame as OpenEXR, in the channels Z and Y."""

from __future__ import annotations

from pathlib import Path

from logvggt_jax.files import atomic_file
from logvggt_jax.reconstruction.exporters.libraries import library
from logvggt_jax.reconstruction.exporters.original_depth import original_depth, write_depth_folder
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction


def export_depth_exr(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Fills a folder with `<frame>.exr`, 32-bit floats at the size of the original images, and `depth.json`.

    Z is the name that the format has for depth. OpenCV and others look for a picture alone and give other numbers
    without a word where there is none: Y, a picture's brightness, holds the same, and is compressed to almost nothing.

    Raises MissingPackage without OpenEXR.
    """
    exr = library("OpenEXR")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}

    def write(file: Path, index: int) -> None:
        depth = original_depth(result, index)
        with atomic_file(file) as temporary, exr.File(header, {"Y": depth, "Z": depth}) as picture:
            picture.write(str(temporary))

    write_depth_folder(result, path, ".exr", write, {"channel": "Z"}, progress=progress)
