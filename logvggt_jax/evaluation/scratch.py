"""Arrays of a clip: in memory while they are small, else in an unnamed temporary file."""

import math
import shutil
import tempfile
from typing import Any

import numpy as np

from logvggt_jax.errors import DiskError

_IN_MEMORY = 256 * 2**20  # bytes


def scratch_array(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Zeros of this shape; beyond 256 MiB in a file that vanishes with the array, however the process ends.

    The file lies in the system's temporary folder (environment variable TMPDIR). Its pages are the operating system's
    to write out, so that clips of any length fit the memory. Raises DiskError naming a folder with too little space.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size <= _IN_MEMORY:
        return np.zeros(shape, dtype)
    folder = tempfile.gettempdir()
    free = shutil.disk_usage(folder).free
    # A full disk would end the process without a word when a page is written.
    if size > free:
        raise DiskError(
            f"{folder}: a clip needs {size / 1e9:.1f} GB here, {free / 1e9:.1f} GB are free; "
            "make room or set TMPDIR to a folder on a larger disk"
        )
    with tempfile.TemporaryFile(prefix="logvggt-") as file:
        return np.memmap(file, dtype, "w+", shape=shape)
