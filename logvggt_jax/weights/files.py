"""VGGT checkpoint files: which file a path means, and its tensors read one by one."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import safetensors

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.weights.lazy import LazyTensors
from logvggt_jax.weights.torch_zip import open_torch_zip

SUFFIXES = (".safetensors", ".pt")
# Where there are several files; the first of them first, since safetensors cannot hold code.
_USUAL_NAMES = ("model.safetensors", "model.pt")


def find_weights(path: Path) -> Path:
    """The checkpoint file that `path` (a file, or a folder that holds one) means.

    Raises MissingInput where nothing is there, or the folder holds no checkpoint; InputError for a suffix that is not
    one of `SUFFIXES`, or a folder with several checkpoints.
    """
    if path.is_dir():
        with disk_errors(path):
            names = [file.name for file in path.iterdir() if file.is_file()]
        return path / choose_weights(names, str(path), f"{path}/")
    if not path.is_file():
        raise MissingInput(f"{path}: no such file or folder; give a checkpoint file or the folder that holds it")
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown suffix {path.suffix!r}; expected a .safetensors or .pt checkpoint")
    return path


def choose_weights(names: Sequence[str], where: str, prefix: str) -> str:
    """The one of these file names that holds a model's weights: the usual name, or the only checkpoint there is.

    Errors call the folder or repository `where`; `prefix` is what a user puts before a name to choose the file. Raises
    MissingInput if none is a checkpoint, InputError naming them if several are and none has a usual name.
    """
    weights = sorted(name for name in names if name.endswith(SUFFIXES))
    usual = [name for name in _USUAL_NAMES if name in weights]
    if usual or len(weights) == 1:
        return (usual or weights)[0]
    if not weights:
        raise MissingInput(f"{where}: holds no .safetensors or .pt file; give the file itself")
    raise InputError(f"{where}: holds several checkpoints, {', '.join(weights)}; give one as {prefix}{weights[0]}")


def open_state_dict(path: str | Path) -> AbstractContextManager[Mapping[str, np.ndarray]]:
    """Opens a `.safetensors` or `.pt` file, or a folder that holds one: PyTorch names to arrays in the file's own
    dtype.

    A context manager; its lazy mapping reads tensors only while it is open. Raises as `find_weights`, and InputError
    for a damaged or truncated file, or a pickle that holds anything but tensors.
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
