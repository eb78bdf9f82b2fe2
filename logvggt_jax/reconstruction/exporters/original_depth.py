"""Depth at the size of the original images."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.files import write_text
from logvggt_jax.reconstruction.exporters.cloud import tracked
from logvggt_jax.reconstruction.exporters.frame_names import file_stems
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.result import Reconstruction

DEPTH_INDEX = "depth.json"
# Neighbours whose depths differ by a larger share lie on two surfaces.
_EDGE = 0.1


def depth_at(depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth [h, w] at another size (H, W), float32; 0 where there is none.

    Within a surface the inverse is interpolated linearly, as it is linear on planes; across edges, where a mean is on
    neither surface, and beside pixels without depth the nearest pixel counts.
    """
    valid = np.isfinite(depth) & (depth > 0)
    depth = np.where(valid, depth, 0).astype(np.float32)
    if depth.shape == size:
        return depth
    nearest = ResizeTransform(original_size=size, size=(depth.shape[0], depth.shape[1])).depth_to_original(depth)
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=valid)
    smooth = cv2.resize(inverse, size[::-1], interpolation=cv2.INTER_LINEAR)
    # Of the four pixels around every corner of pixels, borders repeated.
    padded = np.pad(inverse, 1, mode="edge")
    corners = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
    least, most = corners.min(0), corners.max(0)
    one_surface = (least > 0) & (most <= least * (1 + _EDGE))
    rows, columns = (
        np.floor((np.arange(length) + 0.5) * old / length - 0.5).astype(int) + 1
        for length, old in zip(size, depth.shape, strict=True)
    )
    inside = one_surface[rows[:, None], columns]
    return np.divide(1.0, smooth, out=nearest, where=inside)


def original_depth(result: Reconstruction, index: int) -> np.ndarray:
    """A frame's depth at the size of the original image, [H, W] float32; 0 where there is none."""
    return depth_at(result.depth(index), result.image_size)


def write_depth_folder(
    result: Reconstruction,
    folder: Path,
    suffix: str,
    write: Callable[[Path, int], object],
    facts: Mapping[str, Any],
    *,
    progress: bool,
) -> None:
    """Calls `write` with file and number of every frame, and writes `depth.json`, which says what the files are.

    Args:
      result: whose frames they are.
      folder: to fill.
      suffix: of the files.
      write: called in several threads.
      facts: what there is to say of this format.
      progress: show a progress bar.
    """
    files = [f"{stem}{suffix}" for stem in file_stems(result.names)]
    with FramePool() as pool:
        written = pool.map(lambda index: write(folder / files[index], index), iter(range(len(files))))
        for _ in tracked(written, "Depth", len(files), progress=progress):
            pass
    document = {
        "conventions": "z-depth, 0 where there is none; intrinsics in pixels with centres at integers; extrinsics are "
        "world-to-camera, OpenCV axes",
        "unit": "metre" if result.metric else "the reconstruction's own",
        "image_size": list(result.image_size),
        **facts,
        "frames": [
            {
                "file": file,
                "timestamp": float(result.timestamps[index]),
                "intrinsics": result.intrinsics[index].tolist(),
                "extrinsics": result.extrinsics[index].tolist(),
            }
            for index, file in enumerate(files)
        ],
    }
    write_text(folder / DEPTH_INDEX, json.dumps(document, indent=1) + "\n")
