"""Pictures of some frames beside their depth, all on one scale, with a bar that says what its colours mean."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from logvggt_jax.colours import depth_limits, depth_picture
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.reconstruction.depth_files import write_picture
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.result import Reconstruction, preview_file
from logvggt_jax.reconstruction.result_folder import PREVIEW_FOLDER

# Pixels that image and depth are wide at least.
WIDTH = 512
_GAP, _BAR, _TEXT = 12, 24, 88
_TICKS = 5
# Frames and pixels of each from which the range of depth is taken.
_RANGE_FRAMES, _RANGE_PIXELS = 32, 4096


def write_previews(result: Reconstruction, frames: Sequence[int], pool: FramePool) -> None:
    """Has the pool write a preview of each of these frames into the result's folder."""
    if not frames:
        return
    (result.folder / PREVIEW_FOLDER).mkdir(exist_ok=True)
    near, far = depth_range(result)

    def write(index: int) -> None:
        picture = preview(result.image(index), result.depth(index), near, far, "m" if result.metric else "")
        write_picture(preview_file(result.folder, result.names[index]), picture)

    for index in frames:
        pool.submit(write, index)


def depth_range(result: Reconstruction) -> tuple[float, float]:
    """`depth_limits` of a sequence, from a sample of its pixels."""
    samples = []
    for index in evenly_spaced(result.num_frames, _RANGE_FRAMES):
        depth = result.depth(index).reshape(-1)
        samples.append(depth[:: max(1, len(depth) // _RANGE_PIXELS)])
    return depth_limits(np.concatenate(samples))


def preview(image: np.ndarray, depth: np.ndarray, near: float, far: float, unit: str) -> np.ndarray:
    """Image and depth side by side and the bar of depths, [h, w, 3] uint8; each at least 512 pixels wide.

    Args:
      image: [H, W, 3] uint8 RGB.
      depth: [H, W].
      near: depth of one end of the scale.
      far: depth of the other.
      unit: of depth, for the bar; empty where it is known up to scale.
    """
    height, width = depth.shape
    factor = max(1.0, WIDTH / width)
    size = (round(factor * width), max(1, round(factor * height)))
    shown = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    # Between near and far there is nothing: depths are not blended.
    colours = cv2.resize(depth_picture(depth, near=near, far=far), size, interpolation=cv2.INTER_NEAREST)
    gap = np.full((size[1], _GAP, 3), 255, np.uint8)
    return np.concatenate([shown, gap, colours, gap, _bar(size[1], near, far, unit)], axis=1)


def _bar(height: int, near: float, far: float, unit: str) -> np.ndarray:
    """Far at the top, near at the bottom, and depths beside it, evenly over the bar."""
    share = np.linspace(1, 0, height)
    depths = 1.0 / (1.0 / near + share * (1.0 / far - 1.0 / near))
    strip = depth_picture(np.repeat(depths[:, None], _BAR, axis=1), near=near, far=far)
    bar = np.concatenate([strip, np.full((height, _TEXT, 3), 255, np.uint8)], axis=1)
    for row in np.linspace(0, height - 1, _TICKS).round().astype(int).tolist():
        bar[row, _BAR : _BAR + 4] = 0
        text = f"{depths[row]:.3g} {unit}".rstrip()
        place = (_BAR + 8, min(max(row + 5, 12), height - 3))
        cv2.putText(bar, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return bar
