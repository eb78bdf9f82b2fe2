"""VGGT checkpoint files: which file a path means, and its tensors read one by one."""

import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import numpy as np
import safetensors

from logvggt_jax.errors import InputError, MissingInput, disk_errors, one_line
from logvggt_jax.files import open_regular
from logvggt_jax.weights.content import content_of
from logvggt_jax.weights.lazy import Header, LazyTensors, refused_type
from logvggt_jax.weights.shards import INDEX_SUFFIX, is_shard, present_shards, read_index
from logvggt_jax.weights.state_dicts import plain_names
from logvggt_jax.weights.torch_zip import open_torch_zip

# By which weights are found among other files; what a file holds is told by its content.
SUFFIXES = (".safetensors", ".pt", ".pth", ".ckpt", ".bin")
# Where there are several files; the first of them first, since safetensors cannot hold code.
_USUAL_NAMES = (
    "model.safetensors",
    "model.safetensors.index.json",
    "model.pt",
    "pytorch_model.bin",
    "pytorch_model.bin.index.json",
)
# What trainers write beside the model.
_NO_MODEL = re.compile(r"optim|sched|rng_state|random_state|sampler|scaler|training_args", re.IGNORECASE)
_DISTRIBUTED = ".distcp"
# Types of safetensors that are read, and numpy's names of them.
_FLOATS = {"F64": "float64", "F32": "float32", "F16": "float16", "BF16": "bfloat16"}
_SIGNED = {"I64": "int64", "I32": "int32", "I16": "int16", "I8": "int8", "BOOL": "bool"}
_UNSIGNED = {"U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8"}
_DTYPES = _FLOATS | _SIGNED | _UNSIGNED


def find_weights(path: Path) -> Path:
    """The checkpoint file, or the index of shards, that `path` (a file, or a folder that holds one) means.

    Raises MissingInput where nothing is there, or the folder holds no checkpoint; InputError for one shard of several,
    or a folder with several checkpoints.
    """
    if path.is_dir():
        with disk_errors(path):
            names = [file.name for file in path.iterdir() if file.is_file()]
        if not any(_is_weights(name) or is_shard(name) for name in names):
            # Copies without a suffix, as the hub's cache has them.
            names = [name for name in names if "." not in name and _readable(path / name)] or names
            if len(names) == 1 and "." not in names[0]:
                return path / names[0]
        return path / choose_weights(names, str(path), f"{path}/")
    if not path.is_file():
        what = "neither a file nor a folder" if path.exists() else "no such file or folder"
        if path.is_symlink() and not path.exists():
            what = "a link that leads to nothing, or to itself"
        raise MissingInput(f"{path}: {what}; give a checkpoint file or the folder that holds it")
    if is_shard(path.name):
        raise InputError(f"{path}: one of several shards of a checkpoint; give their folder or their index")
    return path


def choose_weights(names: Sequence[str], where: str, prefix: str) -> str:
    """The one of these file names that holds a model's weights: the usual name, or the only checkpoint there is.

    Errors call the folder or repository `where`; `prefix` is what a user puts before a name to choose the file. Raises
    MissingInput if none is a checkpoint, InputError naming them if several are and none has a usual name.
    """
    weights = sorted(name for name in names if _is_weights(name) and not is_shard(name))
    # macOS leaves ._model.pt beside model.pt on other systems' disks.
    weights = [name for name in weights if not name.startswith(".")] or weights
    weights = [name for name in weights if not _NO_MODEL.search(name)] or weights
    usual = [name for name in _USUAL_NAMES if name in weights]
    if usual or len(weights) == 1:
        return (usual or weights)[0]
    if not weights:
        if any(name.endswith(_DISTRIBUTED) for name in names):
            raise MissingInput(
                f"{where}: a distributed checkpoint of PyTorch, which is not read; make one file of it with python -m "
                f"torch.distributed.checkpoint.format_utils dcp_to_torch {where} model.pt"
            )
        if shards := sorted(name for name in names if is_shard(name)):
            raise MissingInput(
                f"{where}: holds shards ({shards[0]} and {len(shards) - 1} more) without their index; put "
                "model.safetensors.index.json beside them"
            )
        seen = f"it holds {', '.join(sorted(names)[:6])}" if names else "it holds no file"
        raise MissingInput(f"{where}: no file of weights ({', '.join(SUFFIXES)}); {seen}; give the file itself")
    raise InputError(f"{where}: holds several checkpoints, {', '.join(weights)}; give one as {prefix}{weights[0]}")


def open_state_dict(path: str | Path) -> AbstractContextManager[LazyTensors]:
    """Opens a checkpoint file, or a folder that holds one: PyTorch names to arrays in the file's own dtype.

    The content says what the file is: safetensors, an archive of `torch.save`, or the index of several of them. A state
    dict inside of a trainer's checkpoint is found, and prefixes such as `module.` are taken off its names. A context
    manager; its lazy mapping reads tensors only while it is open. Raises as `find_weights`, and InputError for any
    other file, saying what it is; a damaged or truncated one; or a state dict that holds anything but tensors.
    """
    return _open_plain(find_weights(Path(path)))


@contextmanager
def _open_plain(path: Path) -> Iterator[LazyTensors]:
    with ExitStack() as stack:
        if content_of(path) == "json":
            tensors = _enter_shards(stack, path)
        else:
            tensors = stack.enter_context(_open_file(path))
        names = plain_names(list(tensors), str(path))
        yield LazyTensors(
            list(names),
            lambda name: tensors[names[name]],
            tensors.origin,
            lambda name: tensors.header(names[name]),
        )


def _open_file(path: Path) -> AbstractContextManager[LazyTensors]:
    content = content_of(path)
    if content == "json":
        raise InputError(f"{path}: a JSON text, expected weights")
    return open_safetensors(path) if content == "safetensors" else open_torch_zip(path)


def _enter_shards(stack: ExitStack, path: Path) -> LazyTensors:
    weight_map = read_index(path)
    shards = {shard.name: stack.enter_context(_open_file(shard)) for shard in present_shards(path, weight_map)}
    for tensor, name in weight_map.items():
        if tensor not in shards[name]:
            raise InputError(f"{path}: puts {tensor} into {name}, which lacks it; the shards are of another checkpoint")
    return LazyTensors(
        list(weight_map),
        lambda tensor: shards[weight_map[tensor]][tensor],
        header=lambda tensor: shards[weight_map[tensor]].header(tensor),
    )


@contextmanager
def open_safetensors(path: Path) -> Iterator[LazyTensors]:
    """The tensors of one safetensors file under its own names; a context manager, errors as of `open_state_dict`."""
    try:
        with open_regular(path):
            opened = safetensors.safe_open(path, framework="numpy")
    except safetensors.SafetensorError as error:
        raise InputError(
            f"{path}: not a readable safetensors file ({one_line(error)}); it is damaged or truncated, "
            "copy or download it again"
        ) from error
    with opened as file:

        def header(name: str) -> Header:
            found = file.get_slice(name)
            if found.get_dtype() not in _DTYPES:
                raise refused_type(path, name, found.get_dtype())
            return Header(tuple(found.get_shape()), _DTYPES[found.get_dtype()])

        def read(name: str) -> np.ndarray:
            header(name)
            return file.get_tensor(name)

        yield LazyTensors(list(file.keys()), read, header=header)


def _is_weights(name: str) -> bool:
    return name.lower().endswith((*SUFFIXES, *(suffix + INDEX_SUFFIX for suffix in SUFFIXES)))


def _readable(path: Path) -> bool:
    try:
        return content_of(path) != "json"
    except InputError:
        return False
