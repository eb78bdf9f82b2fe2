"""Whether depth, intrinsics and poses of a sequence belong together: one frame's depth seen from another's camera.

Depth of frame i is unprojected, moved into the camera of frame j and compared with the depth stored there at the
nearest pixel. Where all three are right the two agree but for noise, rounding to pixels, occlusions and what moves.
"""

from typing import NamedTuple

import numpy as np

from logvggt_jax.frames import Frames
from logvggt_jax.geometry import project, unproject

# Enough to tell how much of a picture another camera sees.
_POINTS = 2000


class Consistency(NamedTuple):
    """How the depth of one frame agrees with another's."""

    # Median over the compared pixels of |d - z| / d, where z is the depth carried over and d the depth found there; NaN
    # where no pixel was compared. Occluded pixels count, so that it is a median for a reason.
    difference: float
    share: float  # compared pixels over pixels with depth in the first frame, 0 to 1


def depth_consistency(frames: Frames, first: int, second: int) -> Consistency:
    """Carries the depth of frame `first` of `frames` into frame `second` and compares it with the depth there.

    The frames have poses; lengths may have any unit.
    """
    depth = frames.depth[second].astype(np.float64)
    points = _world_points(frames, first)
    u, v, z = _pixels(points, frames.intrinsics[second], frames.extrinsics[second], depth.shape)
    found = depth[v, u]
    known = found > 0
    if not known.any():
        return Consistency(float("nan"), 0.0)
    difference = np.median(np.abs(found[known] - z[known]) / found[known])
    return Consistency(float(difference), float(known.sum() / len(points)))


def differences(frames: Frames, relative: np.ndarray) -> np.ndarray:
    """As the difference of `depth_consistency` from the first to the second of `frames`, of a few pixels, for cameras
    that are to each other as `relative` [M, 4, 4] says, from points of the first to points of the second: [M].

    Infinite where less than half as many pixels can be compared as for the first of them.
    """
    depth, found = frames.depth[0].astype(np.float64), frames.depth[1].astype(np.float64)
    points = unproject(depth, frames.intrinsics[0].astype(np.float64))[depth > 0]
    points = points[:: max(1, len(points) // _POINTS)]
    result, least = np.full(len(relative), np.inf), 1.0
    for index, pose in enumerate(relative):
        u, v, z = _pixels(points, frames.intrinsics[1], pose, found.shape)
        known = found[v, u] > 0
        if index == 0:
            least = max(1.0, known.sum() / 2)
        if known.sum() >= least:
            result[index] = np.median(np.abs(found[v, u][known] - z[known]) / found[v, u][known])
    return result


def visible_shares(frames: Frames, index: int, extrinsics: np.ndarray) -> np.ndarray:
    """Share [M] of the pixels with depth of frame `index` that fall into the view of cameras `extrinsics` [M, 4, 4].

    The cameras have the frame's intrinsics and size; occlusion is not considered. 0 for a frame without depth.
    """
    points = _world_points(frames, index)
    points = points[:: max(1, len(points) // _POINTS)]
    size = frames.depth.shape[1:]
    counts = [len(_pixels(points, frames.intrinsics[index], pose, size)[0]) for pose in extrinsics]
    return np.array(counts) / max(1, len(points))


def _world_points(frames: Frames, index: int) -> np.ndarray:
    """World points [N, 3] float64 of the frame's valid pixels."""
    depth, intrinsics, extrinsics = (
        a[index].astype(np.float64) for a in (frames.depth, frames.intrinsics, frames.extrinsics)
    )
    return unproject(depth, intrinsics, extrinsics)[depth > 0]


def _pixels(
    points: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, size: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest columns and rows (int) and z-depth of those points that fall into a picture of `size` (H, W)."""
    pixels, z = project(points, intrinsics.astype(np.float64), extrinsics.astype(np.float64))
    in_front = z > 0
    pixels, z = np.rint(pixels[in_front]), z[in_front]
    inside = (pixels >= 0).all(-1) & (pixels < [size[1], size[0]]).all(-1)
    u, v = pixels[inside].astype(np.intp).T
    return u, v, z[inside]
