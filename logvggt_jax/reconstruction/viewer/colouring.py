"""What the colours of a cloud's points may say."""

from __future__ import annotations

import numpy as np

from logvggt_jax.colours import COLOUR_MAP, coloured, depth_levels
from logvggt_jax.reconstruction.points.cloud_file import Cloud
from logvggt_jax.reconstruction.result import Reconstruction

IMAGE, DEPTH, CONFIDENCE, TIME = "image", "depth", "confidence", "time"
# Colour maps of OpenCV.
_MAPS = {DEPTH: COLOUR_MAP, CONFIDENCE: "PLASMA", TIME: "TURBO"}
_NEAREST = 1e-6
# Points a step: the depth of all of a large cloud at once would need as much memory again.
_BLOCK = 1_000_000


def colourings(cloud: Cloud) -> tuple[str, ...]:
    """What this cloud can be coloured by."""
    return (IMAGE,) if cloud.frame is None else (IMAGE, DEPTH, CONFIDENCE, TIME)


def palette(colouring: str) -> np.ndarray:
    """The colours [256, 3] uint8 of levels 0 to 1."""
    return coloured(np.linspace(0, 1, 256), _MAPS[colouring])


def point_colours(
    colouring: str, cloud: Cloud, chosen: np.ndarray, result: Reconstruction, limits: tuple[float, float]
) -> np.ndarray:
    """Colours [n, 3] uint8 of the chosen points; `limits` are those of `level_limits`."""
    if colouring == IMAGE:
        return cloud.colours[chosen]
    return coloured(point_levels(colouring, cloud, chosen, result, limits), _MAPS[colouring])


def level_limits(colouring: str, cloud: Cloud, chosen: np.ndarray, result: Reconstruction) -> tuple[float, float]:
    """The values at both ends of the scale: of depth and confidence what nearly all of these points lie between."""
    if colouring == TIME:
        return 0.0, float(max(result.num_frames - 1, 1))
    if not len(chosen) or colouring == IMAGE:
        return 1.0, 2.0
    low, high = np.percentile(_values(colouring, cloud, chosen, result), (2, 98)).tolist()
    if colouring == DEPTH:
        low = max(low, _NEAREST)
    return low, max(high, low + 1e-3 * abs(low), low + _NEAREST)


def point_levels(
    colouring: str, cloud: Cloud, chosen: np.ndarray, result: Reconstruction, limits: tuple[float, float]
) -> np.ndarray:
    """Where the chosen points lie between the limits, [n] float64 in [0, 1]; 1 is near, sure or late."""
    low, high = limits
    values = _values(colouring, cloud, chosen, result)
    if colouring == DEPTH:
        return np.clip(depth_levels(np.maximum(values, _NEAREST), near=low, far=high), 0.0, 1.0)
    return np.clip((values - low) / (high - low), 0.0, 1.0)


def _values(colouring: str, cloud: Cloud, chosen: np.ndarray, result: Reconstruction) -> np.ndarray:
    assert cloud.frame is not None and cloud.confidence is not None  # `colourings` offers nothing else
    frame = cloud.frame[chosen]
    if colouring == TIME:
        return frame.astype(np.float64)
    if colouring == CONFIDENCE:
        return np.log(np.maximum(cloud.confidence[chosen], 1e-6)).astype(np.float64)  # it spans decades
    depth = np.empty(len(chosen))
    axes = result.extrinsics[:, 2].astype(np.float64)
    for start in range(0, len(chosen), _BLOCK):
        part = slice(start, start + _BLOCK)
        axis = axes[frame[part]]
        depth[part] = (axis[:, :3] * cloud.points[chosen[part]]).sum(1) + axis[:, 3]
    return depth
