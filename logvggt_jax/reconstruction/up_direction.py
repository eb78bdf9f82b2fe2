"""Which way is up in a scene."""

from __future__ import annotations

import numpy as np


def up_direction(extrinsics: np.ndarray) -> np.ndarray:
    """The scene's upward direction [3] in the world, from cameras [N, 3|4, 4] (world-to-camera, OpenCV).

    People hold cameras level but seldom straight: whatever they look up or down at, the picture's horizontal is the
    world's. Where cameras turn enough for that to say something, up is across all horizontals; else it is the mean of
    the cameras' own; for cameras that have no common one it is the first camera's.
    """
    rotations = np.asarray(extrinsics, np.float64)[:, :3, :3]
    mean = -rotations[:, 1].mean(0)
    if np.linalg.norm(mean) < 0.1:
        return -rotations[0, 1]
    mean = mean / np.linalg.norm(mean)
    horizontals = rotations[:, 0]
    values, vectors = np.linalg.eigh(horizontals.T @ horizontals / len(horizontals))
    across = vectors[:, 0] * np.copysign(1.0, vectors[:, 0] @ mean)
    # Eigenvalues are mean squared sines; 0.02 is a spread of some ten degrees to either side.
    turned = values[1] > 0.02 and values[0] < 0.1 * values[1]
    return across if turned and across @ mean > 0.5 else mean
