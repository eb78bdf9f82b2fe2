"""Mistakes of people's own recordings that depth and poses tell, also where the camera moves little.

What a wrong direction, wrong axes or another unit do to the figure of `consistency` depends on the camera's way; with a
short one it stays below any limit that noise leaves. Told is therefore a mistake without which the figure would be a
fraction of what it is.
"""

import numpy as np

from logvggt_jax.data.checks.consistency import differences
from logvggt_jax.data.formats.calibration import OPENGL_AXES
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import invert, matrix_to_quaternion, quaternion_to_matrix

# A figure below is as good as any; and what a mistake must divide it by.
_GOOD, _EXPLAINED = 0.01, 2.0
# Poses that jump by a third of the way look like another unit in a third of all single pairs, in 1 of 90 three of them.
_FEWEST = 3
# How often depth may be as long as poses say, without 1 and what noise may be: steps that leave a tenth of the figure.
_FACTORS = np.array([1.25**power for power in range(-31, 32) if abs(power) > 1])
_CAMERAS = (
    "with the poses read the other way round (world-to-camera for camera-to-world, or the reverse)",
    "with y and z of the cameras' axes turned round (OpenGL's for OpenCV's, or the reverse)",
    "with the poses read the other way round and y and z of the cameras' axes turned round",
    "with the first number of the poses' quaternions taken for w, not the last",
)


def figures(frames: Frames) -> np.ndarray:
    """The difference of two `frames` with poses: as they are, without any way between them, and without each of the
    mistakes that `mend` knows."""
    first, second = frames.extrinsics.astype(np.float64)
    axes = OPENGL_AXES
    as_read = second @ invert(first)
    other_way, w_first = invert(second) @ first, _w_first(second) @ invert(_w_first(first))
    cameras = [other_way, axes @ as_read @ axes, axes @ other_way @ axes, w_first]
    scaled = np.tile(as_read, (1 + len(_FACTORS), 1, 1))
    scaled[:, :3, 3] *= np.array([0.0, *_FACTORS])[:, None]
    return differences(frames, np.stack([as_read, scaled[0], *cameras, *scaled[1:]]))


def _w_first(extrinsics: np.ndarray) -> np.ndarray:
    """World-to-camera [4, 4] of a camera-to-world quaternion that was stored as w x y z and read as x y z w."""
    pose = invert(extrinsics)
    pose[:3, :3] = quaternion_to_matrix(np.roll(matrix_to_quaternion(pose[:3, :3]), -1))
    return invert(pose)


def mend(found: np.ndarray) -> str | None:
    """With what mend the `figures` of pairs of frames, [P, M], would be a fraction of what they are, and which; None
    where no mend does that, for each of the pairs and for their median, and of fewer than three pairs."""
    if len(found) < _FEWEST:
        return None
    middle = np.median(found, axis=0)
    best = 2 + int(np.argmin(middle[2:]))
    explained = found[:, best] <= np.maximum(found[:, 0] / _EXPLAINED, _GOOD / 2)
    if middle[0] < _GOOD or middle[best] > middle[0] / _EXPLAINED or not explained.all():
        return None
    if best < 2 + len(_CAMERAS):
        return f"{middle[best]:.1%} {_CAMERAS[best - 2]}"
    if middle[best] > middle[1] / _EXPLAINED:  # poses that jump, and are better without a way between them
        return None
    factor = _FACTORS[best - 2 - len(_CAMERAS)]
    done = "divided" if factor > 1 else "multiplied"
    return f"{middle[best]:.1%} with depth {done} by about {max(factor, 1 / factor):.2g}"
