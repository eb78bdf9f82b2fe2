"""How a recorded picture is turned before it is shown: phones record sideways and write down the rotation."""

from __future__ import annotations

import av
import numpy as np


def display_matrix(frame: av.VideoFrame, stream: av.video.stream.VideoStream) -> np.ndarray | None:
    """[2, 2] matrix D with (x, y) D the place, but for a shift, where the pixel (x, y) is shown; None for none."""
    if data := frame.side_data.get("DISPLAYMATRIX"):
        return np.frombuffer(bytes(data), np.int32)[:9].reshape(3, 3)[:2, :2].astype(np.float64)
    tags = {name.lower(): value for name, value in stream.metadata.items()}
    if tags.get("rotate", "").lstrip("-").isdecimal():
        # Clockwise, as older programs wrote it into any file.
        return np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), round(int(tags["rotate"]) / 90) % 4)
    return None


def _is_transposed(matrix: np.ndarray) -> bool:
    return bool(abs(matrix[0, 1]) > abs(matrix[0, 0]))


def turn(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] turned and mirrored by the matrix, or by the quarter turn nearest to it."""
    if _is_transposed(matrix):
        image, across, down = image.swapaxes(0, 1), matrix[1, 0], matrix[0, 1]
    else:
        across, down = matrix[0, 0], matrix[1, 1]
    return np.ascontiguousarray(image[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def shown_size(frame: av.VideoFrame, matrix: np.ndarray | None) -> tuple[int, int]:
    """(H, W) of a frame after `turn`."""
    turned = matrix is not None and _is_transposed(matrix)
    return (frame.width, frame.height) if turned else (frame.height, frame.width)
