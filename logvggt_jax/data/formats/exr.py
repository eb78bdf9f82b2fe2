"""Single-channel OpenEXR pictures, through the OpenEXR package: OpenCV's wheels come without that codec."""

from pathlib import Path

import numpy as np

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.source_files import check_regular
from logvggt_jax.errors import MissingPackage, install_line


def read_exr(path: str | Path) -> np.ndarray:
    """The only channel of an OpenEXR file, [H, W] float32, in the file's own unit; half floats are widened.

    Raises MissingPackage naming the extra that brings OpenEXR, MissingFiles, or InputError naming the file: truncated
    or damaged, several parts or channels, or integer pixels.
    """
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingPackage(f"{path}: reading EXR needs OpenEXR: {install_line('data')}") from error
    check_regular(path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            count = len(file.parts)
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        # A part whose pixels cannot be decoded is left out, so that asking for it fails.
        raise BrokenPicture(f"{path}: truncated or damaged EXR file ({error}): fetch it again") from error
    if count != 1 or len(channels) != 1:
        raise BrokenPicture(
            f"{path}: expected one part with one channel, got {count} with {', '.join(channels)}: "
            "replace it with the data set's original file"
        )
    (pixels,) = channels.values()
    if not np.issubdtype(pixels.dtype, np.floating):
        raise BrokenPicture(
            f"{path}: expected half or float pixels, got {pixels.dtype}: replace it with the data set's original file"
        )
    return pixels.astype(np.float32)
