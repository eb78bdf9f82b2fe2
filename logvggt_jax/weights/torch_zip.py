"""Tensors of a `.pt` file written by `torch.save`, without PyTorch and without running code.

Such a file is a zip archive with a pickle of the tensors' layout (`<name>/data.pkl`) and one uncompressed
member a storage (`<name>/data/<key>`). A pickle can call any function it names, so the unpickler here resolves
the names that tensors need and nothing else.
"""

import dataclasses
import io
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

from logvggt_jax.errors import InputError, disk_errors
from logvggt_jax.weights.lazy import LazyTensors

_STORAGE_DTYPES = {
    "DoubleStorage": np.dtype(np.float64),
    "FloatStorage": np.dtype(np.float32),
    "HalfStorage": np.dtype(np.float16),
    "BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "LongStorage": np.dtype(np.int64),
    "IntStorage": np.dtype(np.int32),
    "ShortStorage": np.dtype(np.int16),
    "CharStorage": np.dtype(np.int8),
    "ByteStorage": np.dtype(np.uint8),
    "BoolStorage": np.dtype(np.bool_),
}
_MEND = "convert it to model.safetensors with a PyTorch and a source that you trust"


class _RefusedError(Exception):
    """The pickle asks for something other than tensors."""


@dataclasses.dataclass(frozen=True)
class _StorageType:
    """Stands for `torch.FloatStorage` and its kin; cannot be called."""

    dtype: np.dtype


@dataclasses.dataclass(frozen=True)
class _Storage:
    """One member `data/<key>` of the archive, `numel` elements of `dtype`."""

    key: str
    dtype: np.dtype
    numel: int


@dataclasses.dataclass(frozen=True)
class _TensorLayout:
    """A strided view of a storage; offset and strides count elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def __post_init__(self) -> None:
        numbers = (self.offset, *self.shape, *self.strides)
        if not isinstance(self.storage, _Storage) or not all(type(n) is int and n >= 0 for n in numbers):
            raise _RefusedError("a tensor's storage, size, offset or stride is not what torch.save writes")
        if len(self.shape) != len(self.strides):
            raise _RefusedError(f"a tensor of {len(self.shape)} axes has {len(self.strides)} strides")
        size = math.prod(self.shape)
        last = self.offset + sum((n - 1) * s for n, s in zip(self.shape, self.strides, strict=True))
        # A zero stride would let a few bytes stand for a tensor of any size.
        if size and (last >= self.storage.numel or size > self.storage.numel):
            raise _RefusedError(
                f"a tensor of shape {self.shape} reaches beyond its storage {self.storage.key!r} "
                f"of {self.storage.numel} elements"
            )

    def view(self, data: bytes) -> np.ndarray:
        """The tensor over its storage's bytes; raises ValueError where the storage is too short."""
        if len(data) != self.storage.numel * self.storage.dtype.itemsize:
            raise ValueError(
                f"storage {self.storage.key!r} holds {len(data)} bytes, expected "
                f"{self.storage.numel} elements of {self.storage.dtype}"
            )
        flat = np.frombuffer(data, self.storage.dtype)[self.offset :]
        strides = tuple(s * flat.itemsize for s in self.strides)
        return np.lib.stride_tricks.as_strided(flat, self.shape, strides, writeable=False)


class _RebuildTensor:
    """Stands for `torch._utils._rebuild_tensor_v2`; without attributes that a pickle could overwrite."""

    __slots__ = ()

    def __call__(
        self, storage: Any, offset: Any, shape: Any, strides: Any, requires_grad: Any, hooks: Any, metadata: Any = None
    ) -> _TensorLayout:
        return _TensorLayout(storage, offset, tuple(shape), tuple(strides))


class _TensorUnpickler(pickle.Unpickler):
    """Resolves the globals of a pickled state dict; refuses every other one by name."""

    def find_class(self, module: str, name: str, /) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _RebuildTensor()
        if module == "torch" and name in _STORAGE_DTYPES:
            return _StorageType(_STORAGE_DTYPES[name])
        raise _RefusedError(f"the pickle holds code or objects other than tensors: refused {module}.{name}")

    def persistent_load(self, pid: Any, /) -> _Storage:
        match pid:
            case ("storage", _StorageType(dtype=dtype), str(key), str(), int(numel)) if numel >= 0:
                return _Storage(key, dtype, numel)
        raise _RefusedError(f"unknown persistent id {pid!r:.80}, expected a tensor's storage")


@contextmanager
def open_torch_zip(path: Path) -> Iterator[Mapping[str, np.ndarray]]:
    """Opens a state dict written by `torch.save`; tensors are read from the archive when asked for.

    The `.pt` file is a zip archive whose pickle is a flat mapping of names to dense tensors; yields a lazy mapping of
    names to read-only arrays in the file's dtype (bfloat16 as `ml_dtypes.bfloat16`). Raises InputError: not such an
    archive, damaged or big-endian, or a pickle that names anything but tensors. Damage inside a storage is raised when
    its tensor is read.
    """
    try:
        with disk_errors(path):
            opened = zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: {_why_not_a_zip(path)}") from error
    with opened as archive:
        root = _root(archive, path)
        order = _read(archive, f"{root}byteorder", path) if f"{root}byteorder" in archive.namelist() else b"little"
        if order != b"little":
            raise InputError(f"{path}: byte order {order!r:.20} is not supported, expected little-endian; {_MEND}")
        layouts = _layouts(_read(archive, f"{root}data.pkl", path), path)

        def read(name: str) -> np.ndarray:
            layout = layouts[name]
            data = _read(archive, f"{root}data/{layout.storage.key}", path)
            try:
                return layout.view(data)
            except ValueError as error:
                raise InputError(f"{path}: tensor {name}: {error}; the file is damaged, copy it again") from error

        yield LazyTensors(list(layouts), read)


def _why_not_a_zip(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(4)
    if start == b"PK\x03\x04":
        return "the zip archive is truncated or damaged; copy or download the file again"
    if start[:1] == b"\x80":
        return (
            "a bare pickle, as torch.save wrote before PyTorch 1.6; it is not read. Load it in a current PyTorch with "
            "torch.load(path, weights_only=True) and torch.save it again, or save it as model.safetensors"
        )
    return "not a file of torch.save (expected a zip archive); give a model.safetensors or model.pt"


def _root(archive: zipfile.ZipFile, path: Path) -> str:
    roots = [n.removesuffix("data.pkl") for n in archive.namelist() if n == "data.pkl" or n.endswith("/data.pkl")]
    if len(roots) != 1:
        raise InputError(f"{path}: expected one data.pkl in the archive, found {len(roots)}; not a file of torch.save")
    return roots[0]


def _read(archive: zipfile.ZipFile, member: str, path: Path) -> bytes:
    try:
        info = archive.getinfo(member)
        if info.compress_type != zipfile.ZIP_STORED:
            raise InputError(f"{path}: {member} is compressed, torch.save never does that; {_MEND}")
        # Reading to the end checks the member's CRC.
        return archive.read(info)
    except (KeyError, zipfile.BadZipFile, EOFError, OSError) as error:
        reason = f"{member} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path}: {reason}; the file is damaged, copy or download it again") from error


def _layouts(pickled: bytes, path: Path) -> dict[str, _TensorLayout]:
    try:
        state_dict = _TensorUnpickler(io.BytesIO(pickled)).load()
    except _RefusedError as error:
        raise InputError(f"{path}: {error}; {_MEND}") from error
    except Exception as error:
        # A malformed pickle raises whatever its broken instructions run into.
        raise InputError(
            f"{path}: data.pkl is damaged ({type(error).__name__}: {error}); copy or download it again"
        ) from error
    if not isinstance(state_dict, dict):
        raise InputError(f"{path}: holds a {type(state_dict).__name__}, expected a flat state dict of tensors")
    for name, value in state_dict.items():
        if not isinstance(name, str) or not isinstance(value, _TensorLayout):
            raise InputError(
                f"{path}: entry {name!r:.80} is a {type(value).__name__}, expected a flat state dict of tensors; "
                "save model.state_dict() alone"
            )
    return dict(state_dict)
