"""What one frame shows by itself: light, detail, depth; a few numbers and two small pictures."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

# Of the longer edge of the pictures that are kept of every frame.
_CELLS = 24
# Grey levels up to which a pixel is dark, and from which it is bright.
_DARK, _BRIGHT = 20, 250
# Coarse detail is that of pictures so many times smaller.
_COARSE = 4
# Fine detail is looked for in cells, so many along the longer edge.
_DETAIL_CELLS = 12

NUMBERS = ("brightness", "dark", "bright", "sharpness", "detail", "texture", "confidence", "median_depth")


class Look(NamedTuple):
    """What is kept of a frame, 1.3 kB.

    Attributes:
      numbers: float32, in the order of `NUMBERS`; `Measures` says what they are.
      depth: [r, c] float16, at the pixels of `places`; NaN where there is none.
      grey: [r, c] uint8, means over cells.
    """

    numbers: np.ndarray
    depth: np.ndarray
    grey: np.ndarray


def look(image: np.ndarray, depth: np.ndarray, confidence: np.ndarray) -> Look:
    """Looks at a frame.

    Args:
      image: [H, W, 3] uint8 RGB.
      depth: [H, W].
      confidence: [H, W].
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    kept = confidence != 0
    if not kept.all():  # a mask has dropped the others, and they must not pass for light and detail
        grey[~kept] = grey[kept].mean() if kept.any() else 0
    fine = grey.astype(np.float32)
    coarse = cv2.resize(fine, (-(-width // _COARSE), -(-height // _COARSE)), interpolation=cv2.INTER_AREA)
    light = (float(fine.mean()) + 1.0) ** 2
    slopes = np.mean(np.diff(coarse, axis=0) ** 2) + np.mean(np.diff(coarse, axis=1) ** 2)
    edges = cv2.Laplacian(fine, cv2.CV_32F)
    cells_of_detail = tuple(max(1, round(edge * _DETAIL_CELLS / max(height, width))) for edge in (width, height))
    valid = np.isfinite(depth) & (depth > 0)
    rows, columns = places((height, width))
    cells = depth[np.ix_(rows, columns)]
    numbers = (
        fine.mean() / 255,
        np.mean(grey[kept] <= _DARK) if kept.any() else np.nan,
        np.mean(grey[kept] >= _BRIGHT) if kept.any() else np.nan,
        edges.var() / light,
        np.median(cv2.resize(edges**2, cells_of_detail, interpolation=cv2.INTER_AREA)) / light,
        slopes / light,
        np.median(confidence[kept]) if kept.any() else np.nan,
        np.median(depth[valid]) if valid.any() else np.nan,
    )
    return Look(
        np.array(numbers, np.float32),
        np.where(np.isfinite(cells) & (cells > 0), cells, np.nan).astype(np.float16),
        cv2.resize(grey, (len(columns), len(rows)), interpolation=cv2.INTER_AREA),
    )


def places(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of (H, W) whose depth is kept, evenly spread from edge to edge."""
    longer = max(size)
    counts = [max(2, min(edge, round(edge * _CELLS / longer))) for edge in size]
    rows, columns = (np.linspace(0, edge - 1, n).round().astype(int) for edge, n in zip(size, counts, strict=True))
    return rows, columns
