"""Model folders: parameters in Orbax's format, and beside them the configuration and a digest of every leaf.

    <folder>/config.json   format version, ModelConfig, provenance, digests, versions of the libraries that wrote it
    <folder>/params/       Orbax

Orbax restores flipped bytes without complaint; the digests find them.
"""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from rich.console import Console
from rich.progress import Progress

from logvggt_jax.config import ModelConfig, from_mapping
from logvggt_jax.errors import InputError, MissingInput, OutputExists, disk_errors, one_line
from logvggt_jax.files import atomic_folder
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights.files import open_state_dict
from logvggt_jax.weights.hub import licence, resolve
from logvggt_jax.weights.lazy import LazyTensors
from logvggt_jax.weights.provenance import Provenance
from logvggt_jax.weights.vggt import ConversionReport, config_from_vggt, parameter_shapes, params_from_vggt, vggt_rules

FORMAT = "logvggt-jax model"
VERSION = 1
_UNKNOWN = Provenance()
_VGGT_LONGER_EDGE = 518
_MEND = "the checkpoint is damaged: copy or convert it again"


def digests(tree: Any) -> dict[str, str]:
    """BLAKE2b of dtype, shape and bytes of every leaf of a pytree, under its path (`encoder/norm/scale`).

    Leaves are arrays, Python numbers or typed random keys; arrays of several processes have to be replicated.
    """
    return {name: _digest(leaf) for name, leaf in _named_leaves(tree)}


def verify_digests(tree: Any, expected: dict[str, str], where: str) -> None:
    """Compares a restored tree with the digests stored when it was saved; `where` is the checkpoint's path.

    Raises InputError naming the leaf that differs, is missing or has no digest.
    """
    found = digests(tree)
    for name in sorted(found.keys() | expected.keys()):
        if name not in found or name not in expected:
            which = "is not in the checkpoint" if name not in found else "has no digest"
            raise InputError(f"{where}: leaf {name} {which}; {_MEND}")
        if found[name] != expected[name]:
            raise InputError(
                f"{where}: leaf {name} differs from its digest ({found[name]}, expected {expected[name]}); {_MEND}"
            )


def first_misfit(found: Any, expected: Any, asking: str) -> str | None:
    """The first parameter whose shape in the tree `found` is not the `expected` one, in words; None where all fit."""
    theirs, ours = ({name: tuple(leaf.shape) for name, leaf in _named_leaves(tree)} for tree in (found, expected))
    for name in sorted(theirs.keys() | ours.keys()):
        if theirs.get(name) != ours.get(name):
            return f"{name} has shape {theirs.get(name, 'none')}, {asking} asks for {ours.get(name, 'none')}"
    return None


def save_model(path: str | Path, config: ModelConfig, params: Any, provenance: Provenance = _UNKNOWN) -> None:
    """Writes a model folder; an older model folder at `path` is replaced once the new one is complete.

    `params` is the parameter tree, `variables["params"]`; `provenance` says what the weights were trained for and where
    they come from. Raises OutputExists where `path` exists and is not a model folder.
    """
    path = Path(path).expanduser().absolute()
    check_destination(path)
    description = {
        "format": FORMAT,
        "version": VERSION,
        "config": config.to_dict(),
        "provenance": dataclasses.asdict(provenance),
        "digests": digests(params),
        "libraries": {
            name: importlib.metadata.version(name) for name in ("logvggt-jax", "jax", "flax", "orbax-checkpoint")
        },
    }
    with atomic_folder(path, replace=True) as fresh, disk_errors(path):
        with _checkpointer() as checkpointer:
            checkpointer.save(fresh / "params", jax.device_get(params))
            checkpointer.wait_until_finished()
        (fresh / "config.json").write_text(json.dumps(description, indent=2) + "\n")


def check_destination(path: Path) -> None:
    """Raises FileExistsError where `save_model` would have to overwrite something other than a model folder."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    try:
        _read_description(path)
    except InputError as error:
        raise OutputExists(f"{path}: exists and is not a model folder; give another path or remove it") from error


def load_model(path: str | Path) -> tuple[LogVGGT, dict[str, Any]]:
    """The model in a folder and its variables {"params": …}, float32, on the default device.

    `path` is a folder of `save_model`, `logvggt convert` or training (`<workdir>/model`). Raises MissingInput where
    nothing is there, or no model folder; InputError where the configuration has an unknown field, the parameters do not
    fit it, a file is damaged, or a leaf differs from its digest.
    """
    path = Path(path).expanduser().absolute()
    description = _read_description(path)
    try:
        config = ModelConfig.from_dict(description["config"])
    except InputError as error:
        raise InputError(f"{path / 'config.json'}: {error}; written by another version of this package?") from error
    model = LogVGGT(config)
    params = _restore(path / "params", parameter_shapes(config))
    verify_digests(params, description["digests"], str(path))
    return model, {"params": params}


def read_provenance(path_or_repo: str | Path) -> Provenance:
    """What the weights that `from_pretrained` would read were trained for; reads no parameter.

    A folder written before this was recorded gives a `Provenance` of unknowns, a VGGT checkpoint that of VGGT. Raises
    InputError as `from_pretrained`, for what can be seen without reading parameters.
    """
    path = resolve(path_or_repo)
    if not (path.is_dir() and _is_model_folder(path)):
        return _vggt_provenance(path_or_repo)
    description = _read_description(path)
    with _naming(path / "config.json"):
        return from_mapping(Provenance, description.get("provenance", {}), "provenance")


def read_config(path: str | Path, *, dtype: str | None = None, point_head: bool = False) -> ModelConfig:
    """The sizes of the model that `from_pretrained` would give; reads no parameter. `path` is local, see `resolve`."""
    path = Path(path)
    if path.is_dir() and _is_model_folder(path):
        with _naming(path / "config.json"):
            config = ModelConfig.from_dict(_read_description(path)["config"])
    else:
        with open_state_dict(path) as state_dict, _naming(path):
            config = config_from_vggt(state_dict, point_head=point_head)
    return config if dtype is None else dataclasses.replace(config, dtype=dtype)


def from_pretrained(
    path_or_repo: str | Path, *, dtype: str | None = None, point_head: bool = False
) -> tuple[LogVGGT, dict[str, Any]]:
    """A model and its variables from whatever holds weights.

    VGGT-1B is converted in memory; its sizes are read off the tensors' shapes (`config_from_vggt`).

    Args:
      path_or_repo: A model folder of this package; a VGGT `.safetensors` or `.pt` file or a folder that holds one;
        or a hub repository such as `facebook/VGGT-1B`.
      dtype: Compute type of the model, `float32` or `bfloat16`; None keeps the checkpoint's (VGGT: float32).
      point_head: Keep VGGT's point head. A model folder has it or not.

    Raises:
      FileNotFoundError, ValueError: As `load_model`, `open_state_dict` and `params_from_vggt`; one line naming the
        file or tensor.
    """
    path = resolve(path_or_repo)
    if path.is_dir() and _is_model_folder(path):
        model, variables = load_model(path)
        if point_head and model.config.point_head is None:
            raise InputError(f"{path}: the model has no point head; convert VGGT with point_head, or leave it out")
    else:
        with open_state_dict(path) as state_dict, _naming(path):
            config = config_from_vggt(state_dict, point_head=point_head)
            model, variables = LogVGGT(config), {"params": params_from_vggt(state_dict, config)[0]}
    if dtype is not None:
        model = LogVGGT(dataclasses.replace(model.config, dtype=dtype))
    return model, variables


def convert(source: str | Path, destination: str | Path, *, point_head: bool = False) -> ConversionReport:
    """Writes a VGGT checkpoint (a file, its folder, or a hub repository) as a model folder that computes the same as
    VGGT.

    Shows progress, prints how many names were used, skipped and initialised, and returns them; `point_head` keeps the
    point head. Raises OutputExists where the destination is something other than a model folder, and InputError as
    `from_pretrained`. Nothing is left behind.
    """
    destination = Path(destination).expanduser().absolute()
    check_destination(destination)
    path, console = resolve(source), Console()
    with open_state_dict(path) as state_dict, _naming(path):
        config = config_from_vggt(state_dict, point_head=point_head)
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task("Reading tensors", total=len(vggt_rules(config)))

            def read(name: str) -> np.ndarray:
                progress.advance(task)
                return state_dict[name]

            params, report = params_from_vggt(LazyTensors(list(state_dict), read), config)
    with console.status("Writing the model folder"):
        save_model(destination, config, params, _vggt_provenance(source))
    console.print(
        f"{path}: {len(report.used)} tensors used, {len(report.skipped)} skipped, "
        f"{len(report.initialised)} parameters initialised",
        soft_wrap=True,
    )
    return report


def _vggt_provenance(source: str | Path) -> Provenance:
    return Provenance("vggt", _VGGT_LONGER_EDGE, licence(source), f"VGGT checkpoint {source}")


def _checkpointer() -> ocp.StandardCheckpointer:
    # A model folder is one process's own affair, whoever else trains with it.
    alone = ocp.options.MultiprocessingOptions(
        primary_host=jax.process_index(),
        active_processes={jax.process_index()},
        barrier_sync_key_prefix=f"model_of_process_{jax.process_index()}",
    )
    # Orbax's default of 96 GB in flight holds every parameter twice.
    return ocp.StandardCheckpointer(multiprocessing_options=alone, save_concurrent_gb=1, restore_concurrent_gb=1)


def _named_leaves(tree: Any) -> Iterator[tuple[str, Any]]:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        yield jax.tree_util.keystr(path, simple=True, separator="/"), leaf


def _digest(leaf: Any) -> str:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    array = np.asarray(leaf)
    digest = hashlib.blake2b(f"{array.dtype.name}{array.shape}".encode(), digest_size=16)
    digest.update(array.tobytes())
    return digest.hexdigest()


def _is_model_folder(path: Path) -> bool:
    # A hub repository has a config.json as well, but no such folder.
    return (path / "params").is_dir()


def _read_description(path: Path) -> dict[str, Any]:
    file = path / "config.json"
    if not file.is_file():
        raise MissingInput(
            f"{file}: no such file, so the folder is not a model's; give one made by `logvggt convert` or training"
        )
    try:
        with disk_errors(file):
            description = json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not valid JSON ({error}); {_MEND}") from error
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(f"{file}: not the description of a model of this package (format {FORMAT!r})")
    if description.get("version") != VERSION:
        raise InputError(
            f"{file}: format version {description.get('version')!r}, this package reads {VERSION}; "
            "use the version of logvggt-jax that wrote it"
        )
    if not all(isinstance(description.get(part), dict) for part in ("config", "digests")):
        raise InputError(f"{file}: config or digests are missing; {_MEND}")
    return description


def _restore(path: Path, target: Any) -> Any:
    """Parameters in the shapes and placement of `target`, after a check that these are the stored shapes."""
    if not path.is_dir():
        raise MissingInput(f"{path}: the parameters are missing; {_MEND}")

    def read() -> Any:
        with _checkpointer() as checkpointer:
            stored = checkpointer.metadata(path).item_metadata
            if stored is None:
                raise FileNotFoundError("Orbax's description of the parameters is missing")
            if wrong := first_misfit(stored.tree, target, "the configuration in config.json"):
                raise InputError(f"{path}: {wrong}; the two belong to different models")
            return checkpointer.restore(path, target)

    return read_with_orbax(read, f"{path}:", _MEND)


def read_with_orbax(read: Callable[[], Any], where: str, mend: str) -> Any:
    """What `read` returns; what Orbax raises, bare Exception among others, as an InputError with `where` and `mend`.

    An InputError that `read` raises itself passes through.
    """
    try:
        return read()
    except InputError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {one_line(error):.200}"
        raise InputError(f"{where} cannot be read ({reason}); {mend}") from error


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Puts the file's path before errors that know only the tensor."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {error}") from error
