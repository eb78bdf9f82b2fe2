"""Pictures turned by multiples of 90 degrees, with their cameras; turns are counter-clockwise, as in `np.rot90`."""

import numpy as np

from logvggt_jax.data.formats.calibration import pinhole

# A picture's turn is the camera's about its axis, the other way round: x' = y, y' = -x.
_QUARTER = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def turns_to_upright(extrinsics: np.ndarray) -> int:
    """Turns (0 to 3) after which pictures stand upright, for world-to-camera [N, 4, 4] in a world with z up.

    One number for all of them: after it, the upward component of the cameras' upward direction is, on average, the
    largest.
    """
    # What points up in the picture after 0, 1, 2, 3 turns is the old camera's -y, x, y, -x.
    x, y = extrinsics[:, 0, 2].mean(), extrinsics[:, 1, 2].mean()
    return int(np.argmax([-y, x, y, -x]))


def turned_extrinsics(extrinsics: np.ndarray, turns: int) -> np.ndarray:
    """World-to-camera [4, 4] of the turned camera."""
    return np.linalg.matrix_power(_QUARTER, turns) @ extrinsics


def turned_intrinsics(intrinsics: np.ndarray, size: tuple[int, int], turns: int) -> np.ndarray:
    """Intrinsics [3, 3], without skew, of the turned picture; `size` (H, W) is that before the turn."""
    height, width = size
    for _ in range(turns):
        (fx, _, cx), (_, fy, cy), _ = intrinsics
        intrinsics = pinhole(fy, fx, cy, width - 1 - cx)
        height, width = width, height
    return intrinsics
