"""Tensors of a file written by `torch.save`, without PyTorch and without running code.

Such a file is a zip archive with a pickle of the tensors' layout (`<name>/data.pkl`, read by `unpickling`) and one
uncompressed member a storage (`<name>/data/<key>`).
"""

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from logvggt_jax.errors import InputError, disk_errors, one_line
from logvggt_jax.weights.lazy import Header, LazyTensors, refused_type
from logvggt_jax.weights.state_dicts import described, find_state_dict
from logvggt_jax.weights.unpickling import RefusedError, TensorLayout, UnreadTensor, unpickle

_MEND = "convert it to model.safetensors with a PyTorch and a source that you trust"
_STATE_DICT = "save model.state_dict() alone in PyTorch"


@contextmanager
def open_torch_zip(path: Path) -> Iterator[LazyTensors]:
    """Opens a state dict written by `torch.save`; tensors are read from the archive when asked for.

    The archive's pickle is a mapping of names to dense tensors, or a trainer's checkpoint with such a mapping inside;
    yields a lazy mapping of names to read-only arrays in the file's dtype (bfloat16 as `ml_dtypes.bfloat16`). Raises
    InputError: not such an archive, damaged or big-endian, no mapping of tensors in it, or one that holds anything but
    tensors. Damage inside a storage is raised when the tensor is read, a type that is not read with its header too.
    """
    try:
        with disk_errors(path):
            opened = zipfile.ZipFile(path)
    except InputError:
        raise
    except Exception as error:  # of damaged names and versions of the format, any
        raise InputError(f"{path}: the zip archive is truncated or damaged; copy or download the file again") from error
    with opened as archive:
        root = _root(archive, path)
        order = _read(archive, f"{root}byteorder", path) if f"{root}byteorder" in archive.namelist() else b"little"
        if order != b"little":
            raise InputError(f"{path}: byte order {order!r:.20} is not supported, expected little-endian; {_MEND}")
        layouts, origin = _layouts(_read(archive, f"{root}data.pkl", path), path)

        def layout_of(name: str) -> TensorLayout:
            layout = layouts[name]
            if isinstance(layout, UnreadTensor):
                raise refused_type(path, name, layout.kind)
            return layout

        def header(name: str) -> Header:
            layout = layout_of(name)
            return Header(layout.shape, layout.dtype.name)

        def read(name: str) -> np.ndarray:
            layout = layout_of(name)
            data = _read(archive, f"{root}data/{layout.key}", path)
            try:
                return layout.view(data)
            except ValueError as error:
                raise InputError(f"{path}: tensor {name}: {error}; the file is damaged, copy it again") from error

        yield LazyTensors(list(layouts), read, origin, header)


def _root(archive: zipfile.ZipFile, path: Path) -> str:
    names = archive.namelist()
    roots = [name.removesuffix("data.pkl") for name in names if name == "data.pkl" or name.endswith("/data.pkl")]
    if len(roots) != 1:
        if names and all(name.endswith(".npy") for name in names):
            raise InputError(f"{path}: an archive of NumPy arrays; export the PyTorch state dict as model.safetensors")
        raise InputError(
            f"{path}: a zip archive, but not of torch.save: expected one data.pkl, found {len(roots)}; it holds "
            f"{', '.join(names[:4]) or 'nothing'}; unpack it if the checkpoint is inside"
        )
    if f"{roots[0]}constants.pkl" in names:
        raise InputError(f"{path}: a TorchScript program, which is not read; {_STATE_DICT}")
    return roots[0]


def _read(archive: zipfile.ZipFile, member: str, path: Path) -> bytes:
    try:
        info = archive.getinfo(member)
        if info.compress_type != zipfile.ZIP_STORED:
            raise InputError(f"{path}: {member} is compressed, torch.save never does that; {_MEND}")
        # Reading to the end checks the member's CRC.
        return archive.read(info)
    except InputError:
        raise
    except Exception as error:  # a damaged header may ask for a password, among others
        reason = f"{member} is missing" if isinstance(error, KeyError) else one_line(error)
        raise InputError(f"{path}: {reason}; the file is damaged, copy or download it again") from error


def _layouts(pickled: bytes, path: Path) -> tuple[dict[str, TensorLayout | UnreadTensor], str | None]:
    """Names and layouts of the model's tensors, and which entry of the file they are."""
    try:
        tree = unpickle(pickled)
    except RefusedError as error:
        raise InputError(f"{path}: {error}; {_MEND}") from error
    except Exception as error:
        # A malformed pickle raises whatever its broken instructions run into.
        raise InputError(
            f"{path}: data.pkl is damaged ({type(error).__name__}: {one_line(error):.200}); copy or download it again"
        ) from error
    kind = getattr(tree, "kind", None)
    if kind and not isinstance(tree, TensorLayout | UnreadTensor):
        raise InputError(f"{path}: the pickle holds code or objects other than tensors: refused {kind}; {_MEND}")
    if not isinstance(tree, dict):
        raise InputError(
            f"{path}: holds a {kind or type(tree).__name__}, expected a state dict of tensors; {_STATE_DICT}"
        )
    state_dict, origin = find_state_dict(tree, lambda value: isinstance(value, TensorLayout | UnreadTensor), str(path))
    others = {
        name: value
        for name, value in state_dict.items()
        if not isinstance(name, str) or not isinstance(value, TensorLayout | UnreadTensor)
    }
    if others:
        raise InputError(
            f"{path}: beside its tensors the state dict holds {described(others, 3)}, expected tensors alone; "
            f"{_STATE_DICT}"
        )
    return dict(state_dict), origin
