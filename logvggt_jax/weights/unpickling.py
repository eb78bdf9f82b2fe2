"""The pickle inside a file of `torch.save`, read without PyTorch and without running code.

A pickle can call any function it names. The unpickler here knows the names that tensors need; every other one becomes
a placeholder, which takes whatever the pickle does to it, keeps nothing and runs nothing. So a trainer's settings and
optimizer may stand beside a model's tensors, and whoever wants one of them finds that it was not read.
"""

import dataclasses
import io
import math
import pickle
from collections import OrderedDict
from typing import Any

import ml_dtypes
import numpy as np

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


class RefusedError(Exception):
    """The pickle asks for something that torch.save does not write."""


class Foreign:
    """An object of a class that is not read; `kind` is that class. Nothing that a pickle does to it has an effect."""

    __slots__ = ()
    kind = ""

    def __new__(cls, *_: Any, **__: Any) -> "Foreign":
        return object.__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> "Foreign":
        return self

    def __setitem__(self, key: Any, value: Any) -> None:
        pass

    # Without it the unpickler would set attributes. Of a class rather than an object, it gets the state alone.
    def __setstate__(*_: Any) -> None:
        pass

    def append(self, item: Any) -> None:
        """Adds nothing."""

    def extend(self, items: Any) -> None:
        """Adds nothing."""

    def add(self, item: Any) -> None:
        """Adds nothing."""


class _Sealed:
    """What a pickle may not alter once it is made: a tensor is checked then, not again when it is read."""

    def __setstate__(*_: Any) -> None:
        raise RefusedError("a tensor or storage is altered after it was made")


@dataclasses.dataclass(frozen=True)
class _StorageType(_Sealed):
    """Stands for `torch.FloatStorage` and its kin; cannot be called. No `dtype`: the type is not read."""

    name: str
    dtype: np.dtype | None


@dataclasses.dataclass(frozen=True)
class _Storage(_Sealed):
    """One member `data/<key>` of the archive, `numel` elements of a type."""

    key: str
    type: _StorageType
    numel: int


@dataclasses.dataclass(frozen=True)
class UnreadTensor(_Sealed):
    """A tensor of a type that is not read, `kind`: float8, complex and quantised ones."""

    kind: str


@dataclasses.dataclass(frozen=True)
class TensorLayout(_Sealed):
    """A strided view of the member `data/<key>`, `numel` elements of `dtype`; offset and strides count elements."""

    key: str
    dtype: np.dtype
    numel: int
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def __post_init__(self) -> None:
        numbers = (self.offset, *self.shape, *self.strides)
        if not all(type(n) is int and n >= 0 for n in numbers):
            raise RefusedError("a tensor's size, offset or stride is not what torch.save writes")
        if len(self.shape) != len(self.strides):
            raise RefusedError(f"a tensor of {len(self.shape)} axes has {len(self.strides)} strides")
        size = math.prod(self.shape)
        last = self.offset + sum((n - 1) * s for n, s in zip(self.shape, self.strides, strict=True))
        # A zero stride would let a few bytes stand for a tensor of any size.
        if size and (last >= self.numel or size > self.numel):
            raise RefusedError(
                f"a tensor of shape {self.shape} reaches beyond its storage {self.key!r} of {self.numel} elements"
            )

    @property
    def kind(self) -> str:
        """What it is, in words."""
        return f"tensor {self.shape}"

    def view(self, data: bytes) -> np.ndarray:
        """The tensor over its storage's bytes; raises ValueError where the storage is too short."""
        if len(data) != self.numel * self.dtype.itemsize:
            raise ValueError(
                f"storage {self.key!r} holds {len(data)} bytes, expected {self.numel} elements of {self.dtype}"
            )
        flat = np.frombuffer(data, self.dtype)[self.offset :]
        strides = tuple(s * flat.itemsize for s in self.strides)
        return np.lib.stride_tricks.as_strided(flat, self.shape, strides, writeable=False)


class _RebuildTensor:
    """Stands for `torch._utils._rebuild_tensor_v2`; without attributes that a pickle could overwrite."""

    __slots__ = ()

    def __call__(
        self, storage: Any, offset: Any, shape: Any, strides: Any, requires_grad: Any, hooks: Any, metadata: Any = None
    ) -> TensorLayout | UnreadTensor:
        if not isinstance(storage, _Storage):
            raise RefusedError(f"a tensor's storage is a {type(storage).__name__}")
        if storage.type.dtype is None:
            return UnreadTensor(storage.type.name.removesuffix("Storage"))
        return TensorLayout(storage.key, storage.type.dtype, storage.numel, offset, tuple(shape), tuple(strides))


class _RebuildNewTensor:
    """Stands for `torch._utils._rebuild_tensor_v3`, which has the types that have no storage of their own."""

    __slots__ = ()

    def __call__(
        self,
        storage: Any,
        offset: Any,
        shape: Any,
        strides: Any,
        grad: Any,
        hooks: Any,
        dtype: Any,
        metadata: Any = None,
    ) -> UnreadTensor:
        return UnreadTensor(str(getattr(dtype, "kind", dtype)).removeprefix("torch."))


class _RebuildParameter:
    """Stands for `torch._utils._rebuild_parameter`: the parameter's tensor."""

    __slots__ = ()

    def __call__(self, data: Any, *_: Any) -> TensorLayout | UnreadTensor:
        if not isinstance(data, TensorLayout | UnreadTensor):
            raise RefusedError(f"a parameter holds a {type(data).__name__}, expected a tensor")
        return data


class _RebuildFromType:
    """Stands for `torch._tensor._rebuild_from_type_v2`, by which tensors with attributes are kept: the tensor."""

    __slots__ = ()

    def __call__(self, rebuild: Any, kind: Any, arguments: Any, state: Any) -> Any:
        return rebuild(*arguments) if isinstance(rebuild, _REBUILDERS) else Foreign()


_REBUILDERS = (_RebuildTensor, _RebuildNewTensor, _RebuildParameter)
_KNOWN: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _RebuildTensor(),
    ("torch._utils", "_rebuild_tensor_v3"): _RebuildNewTensor(),
    ("torch._utils", "_rebuild_parameter"): _RebuildParameter(),
    ("torch._utils", "_rebuild_parameter_with_state"): _RebuildParameter(),
    ("torch._tensor", "_rebuild_from_type_v2"): _RebuildFromType(),
}


class _TensorUnpickler(pickle.Unpickler):
    """Resolves the names that tensors need; every other one is a `Foreign` class."""

    def find_class(self, module: str, name: str, /) -> Any:
        if (module, name) in _KNOWN:
            return _KNOWN[module, name]
        if module in ("torch", "torch.storage") and name.endswith("Storage"):
            return _StorageType(name, _STORAGE_DTYPES.get(name))
        # A class, since some instructions of pickles make objects of classes only.
        return type("Foreign", (Foreign,), {"__slots__": (), "kind": f"{module}.{name}"})

    def persistent_load(self, pid: Any, /) -> _Storage:
        match pid:
            case ("storage", _StorageType() as kind, str(key), str(), int(numel)) if numel >= 0:
                return _Storage(key, kind, numel)
        raise RefusedError(f"unknown persistent id {pid!r:.80}, expected a tensor's storage")


def unpickle(pickled: bytes) -> Any:
    """What a pickle of `torch.save` holds: containers, numbers and strings, `TensorLayout`s, `UnreadTensor`s, and
    `Foreign` in place of every other object.

    Raises RefusedError for tensors that torch.save does not write, and whatever a malformed pickle's broken
    instructions run into.
    """
    return _TensorUnpickler(io.BytesIO(pickled)).load()
