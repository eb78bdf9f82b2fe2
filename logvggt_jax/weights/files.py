"""VGGT checkpoint files: which file a path means, and its tensors read one by one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import safetensors

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.weights.lazy import LazyTensors
from logvggt_jax.weights.torch_zip import open_torch_zip

# Preferred first: safetensors cannot hold code.
WEIGHT_FILES = ("model.safetensors", "model.pt")


def find_weights(path: Path) -> Path:
    """The checkpoint file that `path` (a file, or a folder with one of `WEIGHT_FILES`) means.

    Raises:
      FileNotFoundError: Nothing is there, or the folder holds none of the known files.
      ValueError: The file's suffix is neither `.safetensors` nor `.pt`.
    """
    if path.is_dir():
        for name in WEIGHT_FILES:
            if (path / name).is_file():
                return path / name
        raise MissingInput(f"{path}: the folder holds no {' or '.join(WEIGHT_FILES)}; give the file itself")
    if not path.is_file():
        raise MissingInput(f"{path}: no such file or folder; give a checkpoint file or the folder that holds it")
    if path.suffix not in (".safetensors", ".pt"):
        raise InputError(f"{path}: unknown suffix {path.suffix!r}; expected a .safetensors or .pt checkpoint")
    return path


def open_state_dict(path: str | Path) -> AbstractContextManager[Mapping[str, np.ndarray]]:
    """Opens a checkpoint as a lazy mapping of PyTorch names to arrays, in the file's own dtype.

    Args:
      path: A `.safetensors` or `.pt` file, or a folder with `model.safetensors` or `model.pt`.

    Returns:
      A context manager; the mapping reads tensors only while it is open.

    Raises:
      FileNotFoundError, ValueError: As `find_weights`; ValueError also for a damaged or truncated file, and for
        a pickle that holds anything but tensors.
    """
    file = find_weights(Path(path))
    return _open_safetensors(file) if file.suffix == ".safetensors" else open_torch_zip(file)


@contextmanager
def _open_safetensors(path: Path) -> Iterator[Mapping[str, np.ndarray]]:
    try:
        with disk_errors(path):
            opened = safetensors.safe_open(path, framework="numpy")
    except safetensors.SafetensorError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: not a readable safetensors file ({reason}); it is damaged or truncated, copy or download it again"
        ) from error
    with opened as file:
        yield LazyTensors(list(file.keys()), file.get_tensor)
