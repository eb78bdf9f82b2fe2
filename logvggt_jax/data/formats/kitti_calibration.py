"""Calibration files of KITTI: lines `name: numbers`, among them the projections of the rectified cameras."""

from pathlib import Path

import numpy as np

from logvggt_jax.data.formats.calibration import numbers
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError


def read_projection(files: SourceFiles, path: Path, name: str, expected: str) -> np.ndarray:
    """Projection [3, 4] float64 called `name`: from points of the rectified camera 0, in metres, to pixels.

    Its left 3 x 3 are the camera's intrinsics. Raises MissingFiles saying what was `expected`, or InputError naming
    `path`: no such line, or another number of numbers in it.
    """
    for line in files.text(path, expected).splitlines():
        if line.startswith(f"{name}:"):
            return numbers(line.removeprefix(f"{name}:"), f"{path}, {name}", count=12).reshape(3, 4)
    raise InputError(f"{path}: no line {name}: fetch the calibration again")
