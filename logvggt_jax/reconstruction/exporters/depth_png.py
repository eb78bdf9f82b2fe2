"""Depth of every frame as 16-bit PNG, with the scale that makes lengths of its numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from logvggt_jax.reconstruction.depth_files import write_picture
from logvggt_jax.reconstruction.exporters.original_depth import original_depth, write_depth_folder
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction

_LARGEST = 65535
_MILLIMETRE = 0.001
# Depth beyond so many times the median is left out where it would make the steps coarse: it is sky or a fault.
_FAR = 64.0


def export_depth_png(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Fills a folder with `<frame>.png`, 16 bits, at the size of the original images, and `depth.json`.

    Depth is the number times `scale` of `depth.json`, one scale for all frames: a thousandth where lengths are metres
    and that reaches far enough, else what puts the farthest depth at 65535. 0 is no depth.
    """
    scale = _scale(result)

    def write(file: Path, index: int) -> None:
        levels = np.rint(original_depth(result, index) / scale)
        write_picture(file, np.where(levels <= _LARGEST, levels, 0).astype(np.uint16))

    facts = {"scale": scale, "reading": "depth = number * scale; 0 is none"}
    write_depth_folder(result, path, ".png", write, facts, progress=progress)


def _scale(result: Reconstruction) -> float:
    with FramePool() as pool:
        extents = np.array(list(pool.map(lambda index: _extent(result, index), iter(range(result.num_frames)))))
    farthest = min(extents[:, 0].max(), _FAR * np.median(extents[:, 1]))
    if result.metric and farthest <= _LARGEST * _MILLIMETRE:
        return _MILLIMETRE
    return float(farthest) / _LARGEST if farthest > 0 else 1.0


def _extent(result: Reconstruction, index: int) -> tuple[float, float]:
    """Largest and median depth of a frame."""
    depth = result.depth(index)
    valid = depth[np.isfinite(depth) & (depth > 0)]
    return (float(valid.max()), float(np.median(valid))) if valid.size else (0.0, 0.0)
