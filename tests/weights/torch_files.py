"""Files as `torch.save` writes them, and state dicts in VGGT's form, made without PyTorch."""

import dataclasses
import struct
import zipfile

import ml_dtypes
import numpy as np

from logvggt_jax.config import (
    AggregatorConfig,
    CameraHeadConfig,
    DPTConfig,
    EncoderConfig,
    ModelConfig,
    RefinementConfig,
)
from logvggt_jax.weights.vggt import vggt_rules

STORAGES = {
    np.dtype(np.float32): "FloatStorage",
    np.dtype(np.float16): "HalfStorage",
    np.dtype(ml_dtypes.bfloat16): "BFloat16Storage",
    np.dtype(np.int64): "LongStorage",
}


def small_vggt_config():
    """VGGT's depth of 24, which its key layers need, at the smallest widths."""
    head = DPTConfig(features=8, out_channels=(4, 8, 12, 8))
    return ModelConfig(
        encoder=EncoderConfig(embed_dim=16, depth=1, num_heads=2, position_grid=3),
        aggregator=AggregatorConfig(num_heads=2),
        camera_head=CameraHeadConfig(depth=1, num_heads=2),
        depth_head=head,
        point_head=head,
        refinement=RefinementConfig(num_heads=2),
    )


def random_state_dict(config):
    """Random tensors for a configuration, two tensors of a track head included."""
    rng = np.random.default_rng(0)
    tensors = {rule.name: rng.standard_normal(rule.shape, np.float32) for rule in vggt_rules(config)}
    for name in ("feature_extractor.norm.weight", "tracker.fnet.bias"):
        tensors[f"track_head.{name}"] = rng.standard_normal(5, np.float32)
    return tensors


@dataclasses.dataclass(frozen=True)
class View:
    """A tensor as torch sees it: a shape and strides (in elements) over a storage."""

    storage: np.ndarray
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Instance:
    """An object of a class with attributes, as trainers keep their settings."""

    module: str
    name: str
    attributes: dict


def _text(value):
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def _integer(value):
    return b"J" + struct.pack("<i", value)


def _tuple(*items):
    return b"(" + b"".join(items) + b"t"


def _global(module, name):
    return f"c{module}\n{name}\n".encode()


_EMPTY_ORDERED_DICT = _global("collections", "OrderedDict") + b")R"


def _tensor(view, key):
    storage = _tuple(
        _text("storage"),
        _global("torch", STORAGES[view.storage.dtype]),
        _text(key),
        _text("cpu"),
        _integer(view.storage.size),
    )
    arguments = _tuple(
        storage + b"Q",
        _integer(view.offset),
        _tuple(*map(_integer, view.shape)),
        _tuple(*map(_integer, view.strides)),
        b"\x89",
        _EMPTY_ORDERED_DICT,
    )
    return _global("torch._utils", "_rebuild_tensor_v2") + arguments + b"R"


def _pickled(value, storages):
    """Instructions that make a value; arrays and views become tensors whose storages are added to `storages`."""
    if isinstance(value, np.ndarray):
        strides = tuple(s // value.itemsize for s in value.strides)
        value = View(np.ravel(value), 0, value.shape, strides)
    match value:
        case View():
            key, _ = storages.setdefault(id(value.storage), (str(len(storages)), value.storage))
            return _tensor(value, key)
        case Instance():
            return _global(value.module, value.name) + b")\x81" + _pickled(value.attributes, storages) + b"b"
        case dict():
            items = b"".join(_pickled(name, storages) + _pickled(item, storages) for name, item in value.items())
            return b"}(" + items + b"u"
        case list():
            return b"](" + b"".join(_pickled(item, storages) for item in value) + b"e"
        case str():
            return _text(value)
        case float():
            return b"G" + struct.pack(">d", value)
        case int():
            return _integer(value)
    raise TypeError(value)


def write_torch_file(path, content, *, pickled=None, byteorder=b"little", compression=zipfile.ZIP_STORED):
    """Writes a file as `torch.save` does; returns its path.

    `content` maps names to arrays, `View`s, numbers, texts, lists, `Instance`s and mappings of these; equal storages
    are stored once. `pickled` replaces the pickle.
    """
    storages = {}
    items = b"".join(_text(name) + _pickled(value, storages) for name, value in content.items())
    # An OrderedDict whose module metadata is an attribute, as Module.state_dict() returns it.
    metadata = b"}" + _text("_metadata") + _EMPTY_ORDERED_DICT + b"s"
    state_dict = b"\x80\x02" + _EMPTY_ORDERED_DICT + b"(" + items + b"u" + metadata + b"b."
    root = path.stem
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"{root}/data.pkl", state_dict if pickled is None else pickled)
        archive.writestr(f"{root}/byteorder", byteorder)
        for key, storage in storages.values():
            archive.writestr(f"{root}/data/{key}", storage.tobytes())
        archive.writestr(f"{root}/version", b"3\n")
    return path
