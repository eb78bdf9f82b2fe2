"""Depth and confidence of every frame as numpy archives."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.files import atomic_file
from logvggt_jax.reconstruction.exporters.original_depth import depth_at, write_depth_folder
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction


def export_depth_npz(
    result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
) -> None:
    """Fills a folder with `<frame>.npz` at the size of the original images, and `depth.json`.

    Each holds `depth` [H, W] float32 (0 where there is none), `confidence` [H, W] float16 of the nearest pixel that the
    model has seen, `intrinsics` [3, 3] and `extrinsics` [3, 4] float64.
    """
    transform = ResizeTransform(result.image_size, result.depth_size)

    def write(file: Path, index: int) -> None:
        depth, confidence = result.depth_and_confidence(index)
        with atomic_file(file) as temporary:
            np.savez_compressed(
                temporary,
                depth=depth_at(depth, result.image_size),
                confidence=transform.depth_to_original(confidence.astype(np.float16)),
                intrinsics=result.intrinsics[index],
                extrinsics=result.extrinsics[index],
            )

    facts = {"arrays": "depth, confidence, intrinsics, extrinsics"}
    write_depth_folder(result, path, ".npz", write, facts, progress=progress)
