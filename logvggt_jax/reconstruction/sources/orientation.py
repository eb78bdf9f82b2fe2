"""How a recorded picture is turned before it is shown: phones record sideways and write down the rotation.

A display matrix [2, 2] is D where (x, y) D is the place, but for a shift, at which the pixel (x, y) is shown.
"""

import numpy as np


def turn(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] turned and mirrored by the display matrix, or by the quarter turn nearest to it."""
    if _is_transposed(matrix):
        image, across, down = image.swapaxes(0, 1), matrix[1, 0], matrix[0, 1]
    else:
        across, down = matrix[0, 0], matrix[1, 1]
    return np.ascontiguousarray(image[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def shown_size(stored: tuple[int, int], matrix: np.ndarray | None) -> tuple[int, int]:
    """(H, W) after `turn`."""
    return stored[::-1] if matrix is not None and _is_transposed(matrix) else stored


def _is_transposed(matrix: np.ndarray) -> bool:
    return bool(abs(matrix[0, 1]) > abs(matrix[0, 0]))
