"""How a recorded picture is turned before it is shown: phones record sideways and write down the rotation.

A display matrix [2, 2] is D where (x, y) D is the place, but for a shift, at which the pixel (x, y) is shown.
"""

import re
import warnings
from types import MappingProxyType

import numpy as np
from PIL import ExifTags, Image

_EXIF = re.compile(rb"\xff\xe1(..)Exif\0\0", re.DOTALL)
# Bytes of a JPEG within which cameras write it.
_HEAD = 1 << 16
# By EXIF orientation, for those that turn or mirror.
_MATRICES = MappingProxyType(
    {
        2: ((-1, 0), (0, 1)),
        3: ((-1, 0), (0, -1)),
        4: ((1, 0), (0, -1)),
        5: ((0, 1), (1, 0)),
        6: ((0, 1), (-1, 0)),
        7: ((0, -1), (-1, 0)),
        8: ((0, -1), (1, 0)),
    }
)


def noted_orientation(jpeg: bytes) -> int:
    """The EXIF orientation that the camera noted in a JPEG; 1 where it noted none, or one that does not exist."""
    found = _EXIF.search(jpeg, 0, _HEAD)
    if found is None:
        return 1
    exif = Image.Exif()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what else is odd about them
        try:
            exif.load(jpeg[found.start() + 4 : found.start() + 2 + int.from_bytes(found[1], "big")])
            orientation = exif.get(ExifTags.Base.Orientation, 1)
        except Exception:  # Pillow raises whatever its parsing of damaged data stumbles over
            return 1
    return orientation if orientation in _MATRICES else 1


def matrix_of(orientation: int) -> np.ndarray | None:
    """The display matrix of an EXIF orientation; None where nothing is turned."""
    return np.array(_MATRICES[orientation], np.float64) if orientation in _MATRICES else None


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
