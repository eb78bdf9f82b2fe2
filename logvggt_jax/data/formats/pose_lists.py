"""Text files that hold the poses of all frames of a sequence as matrices."""

from pathlib import Path

import numpy as np

from logvggt_jax.data.errors import UnequalCounts
from logvggt_jax.data.formats.calibration import numbers
from logvggt_jax.data.formats.source_files import SourceFiles


def read_pose_list(files: SourceFiles, path: Path, *, count: int, numbers_per_line: int = 16) -> np.ndarray:
    """Matrices [count, 4, 4] float64 as stored, row-major; NaN and infinite entries are kept. Empty lines are skipped.

    A line has 16 numbers, or 4 where a matrix takes four lines, or 12 for matrices [count, 3, 4]. Raises MissingFiles,
    or InputError naming file and line: other words or another number of them, or another number of matrices than the
    `count` of frames.
    """
    lines = enumerate(files.text(path, "the poses of the sequence's frames").splitlines(), 1)
    rows = [numbers(line, f"{path}, line {i}", count=numbers_per_line) for i, line in lines if line.strip()]
    lines_per_pose = 4 if numbers_per_line == 4 else 1
    if len(rows) != count * lines_per_pose:
        raise UnequalCounts(
            f"{path}: expected {count} poses of {lines_per_pose} lines for {count} pictures, got {len(rows)} lines: "
            "fetch the file and the pictures again"
        )
    return np.reshape(rows, (count, -1, 4))
