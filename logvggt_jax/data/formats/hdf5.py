"""Arrays from HDF5 files that hold one array each, with damage reported by file."""

import io
from pathlib import Path

import numpy as np

from logvggt_jax.data.errors import BrokenPicture
from logvggt_jax.data.formats.source_files import check_regular
from logvggt_jax.errors import MissingPackage, install_line


def read_hdf5(
    path: str | Path, dataset: str, *, shape: tuple[int | None, ...], content: bytes | None = None
) -> np.ndarray:
    """Array `dataset` of an HDF5 file, in the file's own type and unit.

    Its shape must be `shape`, where None stands for any length; `content` are the file's bytes, where they have been
    read already. Raises MissingPackage naming the extra that brings h5py, MissingFiles, or InputError naming the file:
    not an HDF5 file, truncated or damaged, no such array, not numbers or another shape.
    """
    try:
        import h5py
    except ImportError as error:
        raise MissingPackage(f"{path}: reading HDF5 needs h5py: {install_line('data')}") from error
    if content is None:
        check_regular(path)
    try:
        with h5py.File(path if content is None else io.BytesIO(content), "r") as file:
            # Damaged ones come as bytes.
            names = [name if isinstance(name, str) else name.decode(errors="replace") for name in file]
            array = file[dataset][()] if isinstance(file.get(dataset), h5py.Dataset) else None
    except (OSError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        raise BrokenPicture(f"{path}: truncated or damaged HDF5 file ({reason}): fetch it again") from error
    if array is None:
        raise BrokenPicture(
            f"{path}: no array {dataset!r}, only {', '.join(names) or 'nothing'}: "
            "replace it with the data set's original file"
        )
    array = np.asarray(array)
    fits = len(array.shape) == len(shape) and all(
        wanted in (None, given) for wanted, given in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "iuf":
        expected = " x ".join("any" if length is None else str(length) for length in shape)
        raise BrokenPicture(
            f"{path}: expected numbers of shape {expected} in {dataset!r}, got {array.dtype} {array.shape}: "
            "replace it with the data set's original file"
        )
    return array
