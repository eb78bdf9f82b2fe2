"""Model folders: parameters, and beside them the configuration and a digest of every leaf.

    <folder>/config.json   format version, ModelConfig, provenance, digests, versions of the libraries that wrote it,
                           and a digest of all this
    <folder>/params/       Orbax; or, in models that ship with the package, params.safetensors at 16 bits a number

Flipped bytes are restored without complaint; the digests, of the float32 parameters that come back, find them.
"""

import contextlib
import dataclasses
import importlib.metadata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import orbax.checkpoint as ocp
from rich.console import Console
from rich.progress import Progress

from logvggt_jax.config import ModelConfig, from_mapping
from logvggt_jax.errors import InputError, MissingInput, OutputExists, disk_errors, one_line
from logvggt_jax.files import (
    FolderKind,
    atomic_folder,
    check_apart,
    check_output,
    check_regular_files,
    check_space,
    check_writable,
    user_path,
)
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights.address import hub_address, resolve, similar
from logvggt_jax.weights.digests import are_comparable, check_finite, digests, named_leaves, verify_digests
from logvggt_jax.weights.files import open_state_dict
from logvggt_jax.weights.folder import MEND, is_model_folder, read_description, run_model, write_description
from logvggt_jax.weights.half_precision import PARAMETERS_FILE, read_parameters, rounded, write_parameters
from logvggt_jax.weights.hub import licence
from logvggt_jax.weights.lazy import LazyTensors
from logvggt_jax.weights.orbax_paths import as_it_is_named
from logvggt_jax.weights.orbax_writing import writing_with_orbax
from logvggt_jax.weights.provenance import Provenance
from logvggt_jax.weights.shipped_models import SHIPPED, shipped_model
from logvggt_jax.weights.vggt import (
    ConversionReport,
    check_vggt,
    config_from_vggt,
    parameter_shapes,
    params_from_vggt,
    vggt_rules,
)

_UNKNOWN = Provenance()
_VGGT_LONGER_EDGE = 518
_MODEL_FOLDER = FolderKind("config.json", ("config.json", "params", PARAMETERS_FILE))
# Of arrays that Orbax holds at once; by its default of 96 every parameter is there twice.
_GB_IN_FLIGHT = 1


def first_misfit(found: Any, expected: Any, asking: str) -> str | None:
    """The first parameter whose shape in the tree `found` is not the `expected` one, in words; None where all fit."""
    theirs, ours = ({name: tuple(leaf.shape) for name, leaf in named_leaves(tree)} for tree in (found, expected))
    for name in sorted(theirs.keys() | ours.keys()):
        if theirs.get(name) != ours.get(name):
            return f"{name} has shape {theirs.get(name, 'none')}, {asking} asks for {ours.get(name, 'none')}"
    return None


def save_model(
    path: str | Path, config: ModelConfig, params: Any, provenance: Provenance = _UNKNOWN, *, replace: bool = True
) -> None:
    """Writes a model folder; with `replace` an older model folder at `path` goes once the new one is complete.

    `params` is the parameter tree, `variables["params"]`; `provenance` says what the weights were trained for and where
    they come from. Raises OutputExists where `path` exists and is not a model folder, or is not to be replaced.
    """
    path = user_path(path).absolute()
    check_destination(path)
    description = _description(config, params, provenance)
    with atomic_folder(path, replace=replace) as fresh, writing_with_orbax(path):
        write_arrays(fresh / "params", params)
        write_description(fresh, description)


def write_arrays(path: Path, tree: Any) -> None:
    """Writes a pytree of arrays, which this process holds whole, as a new folder in Orbax's format."""
    # Numbers of a network do not compress: a tenth of the space would take three times the processor's time.
    # Nor does Orbax need copies of arrays that stay as they are until it has ended.
    uncopied = ocp.type_handlers.NumpyHandler(deepcopy_host_arrays=False)
    kinds = (np.ndarray, uncopied), (jax.Array, ocp.type_handlers.ArrayHandler())
    handler = ocp.PyTreeCheckpointHandler(
        use_compression=False,
        save_concurrent_gb=_GB_IN_FLIGHT,
        multiprocessing_options=_alone(),
        type_handler_registry=ocp.type_handlers.create_type_handler_registry(*kinds),
    )
    with (
        as_it_is_named(path) as where,
        ocp.AsyncCheckpointer(handler, multiprocessing_options=_alone()) as checkpointer,
    ):
        checkpointer.save(where, args=ocp.args.PyTreeSave(jax.tree.map(np.asarray, jax.device_get(tree))))
        checkpointer.wait_until_finished()


def read_arrays(path: Path, target: Any) -> Any:
    """A folder of `write_arrays` in the shapes and placement of `target`.

    Of several processes each reads its own part. What Orbax raises passes through, see `read_with_orbax`.

    Raises InputError where a pipe or a device lies in a file's place, for which Orbax would wait.
    """
    check_regular_files(path)
    with as_it_is_named(path) as where, _reader() as checkpointer:
        return checkpointer.restore(where, target)


def save_rounded_model(path: str | Path, config: ModelConfig, params: Any, provenance: Provenance) -> float:
    """Writes a model folder with its parameters in one file at 16 bits a number, in place of an older model folder.

    Returns how much rounding changed the parameters (`rounded`). Raises OutputExists as `save_model`.
    """
    path = user_path(path).absolute()
    check_destination(path)
    leaves, change = rounded(params)
    with atomic_folder(path, replace=True) as fresh, disk_errors(path):
        write_parameters(fresh, leaves)
        write_description(fresh, _description(config, read_parameters(fresh), provenance))
    return change


def _description(config: ModelConfig, params: Any, provenance: Provenance) -> dict[str, Any]:
    return {
        "config": config.to_dict(),
        "provenance": provenance.to_dict(),
        "digests": digests(params),
        "libraries": {
            name: importlib.metadata.version(name) for name in ("logvggt-jax", "jax", "flax", "orbax-checkpoint")
        },
    }


def check_destination(path: Path) -> None:
    """Raises FileExistsError where `save_model` would have to overwrite something other than a model folder."""
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    try:
        read_description(path)
    except InputError as error:
        raise OutputExists(f"{path}: exists and is not a model folder; give another path or remove it") from error


def load_model(path: str | Path, *, on_host: bool = False) -> tuple[LogVGGT, dict[str, Any]]:
    """The model in a folder and its variables {"params": …}, float32, on the default device until put elsewhere: they
    are committed to none, so that a program over a mesh takes them as they are. With `on_host` they are numpy
    arrays that no device has seen.

    `path` is a folder of `save_model`, `logvggt convert` or training (`<workdir>/model`, or `<workdir>` for short), or
    the name of a model that ships with the package: `rooms`, unless a model folder of that name is here.
    Raises MissingInput where nothing is there, or no model folder; InputError where the configuration has an unknown
    field, the parameters do not fit it, a file is damaged, a leaf or the description differs from its digest, or a
    parameter is NaN or infinite.
    """
    path = shipped_model(path) or run_model(user_path(path).absolute())
    if not path.exists():
        raise MissingInput(
            f"{path / 'config.json'}: no such folder{similar(path)}; give a model folder, or a model that ships with "
            f"this package: {', '.join(SHIPPED)}"
        )
    description = read_description(path)
    try:
        config = ModelConfig.from_dict(description["config"])
    except InputError as error:
        raise InputError(f"{path / 'config.json'}: {error}; written by another version of this package?") from error
    model = LogVGGT(config)
    restore = _restore_rounded if (path / PARAMETERS_FILE).exists() else _restore
    params = restore(path, parameter_shapes(config))
    verify_digests(params, description["digests"], str(path))
    check_finite(params, str(path))
    return model, {"params": params if on_host else jax.device_put(params)}


def read_provenance(path_or_repo: str | Path) -> Provenance:
    """What the weights that `from_pretrained` would read were trained for; reads no parameter.

    A folder written before this was recorded gives a `Provenance` of unknowns, a VGGT checkpoint that of VGGT. Raises
    InputError as `from_pretrained`, for what can be seen without reading parameters.
    """
    path = resolve(path_or_repo)
    if not (path.is_dir() and is_model_folder(path)):
        return _vggt_provenance(path_or_repo)
    description = read_description(path)
    with _naming(path / "config.json"):
        return from_mapping(Provenance, description.get("provenance", {}), "provenance")


def read_licence(path_or_repo: str | Path) -> str | None:
    """The licence of weights that `from_pretrained` reads, None where it is not known; fetches nothing but its name.

    Raises InputError as `read_provenance`, or where a hub has no such repository.
    """
    address = hub_address(path_or_repo)
    return read_provenance(path_or_repo).licence if address is None else licence(address[0])


def read_config(path: str | Path, *, dtype: str | None = None, point_head: bool = False) -> ModelConfig:
    """The sizes of the model that `from_pretrained` would give; reads no parameter. `path` is local, see `resolve`.

    Raises InputError as `from_pretrained`, for what can be seen without reading parameters: of a VGGT checkpoint its
    tensors' names, shapes and types.
    """
    path = Path(path)
    if path.is_dir() and is_model_folder(path):
        with _naming(path / "config.json"):
            config = ModelConfig.from_dict(read_description(path)["config"])
    else:
        with open_state_dict(path) as state_dict, _naming(path):
            config = config_from_vggt(state_dict, point_head=point_head)
            check_vggt(state_dict, config)
    return config if dtype is None else dataclasses.replace(config, dtype=dtype)


def read_digests(path: str | Path) -> dict[str, str] | None:
    """The `digests` of the parameters that `from_pretrained` would give, where a model folder tells them; reads no
    parameter. None for a VGGT checkpoint, and for a folder of an earlier version. `path` is local, see `resolve`.

    Raises InputError as `from_pretrained`, for what can be seen without reading parameters.
    """
    path = Path(path)
    if not (path.is_dir() and is_model_folder(path)):
        return None
    found: dict[str, str] = read_description(path)["digests"]
    return found if found and are_comparable(found.values()) else None


def from_pretrained(
    path_or_repo: str | Path, *, dtype: str | None = None, point_head: bool = False, on_host: bool = False
) -> tuple[LogVGGT, dict[str, Any]]:
    """A model and its variables from whatever holds weights.

    VGGT-1B is converted in memory; its sizes are read off the tensors' shapes (`config_from_vggt`).

    Args:
      path_or_repo: A model folder of this package, a training run's folder, or the name of a model that ships
        (`rooms`); a VGGT checkpoint as `open_state_dict` reads it; or a hub repository, `hf:owner/name` or
        `owner/name` (`resolve`).
      dtype: Compute type of the model, `float32`, `bfloat16` or `float16`; None keeps the checkpoint's (VGGT: float32).
      point_head: Keep VGGT's point head. A model folder has it or not.
      on_host: Give numpy arrays, which no device has seen. Those of a VGGT checkpoint are so in any case.

    Raises:
      FileNotFoundError, ValueError: As `load_model`, `open_state_dict` and `params_from_vggt`; one line naming the
        file or tensor.
    """
    path = resolve(path_or_repo)
    if path.is_dir() and is_model_folder(path):
        model, variables = load_model(path, on_host=on_host)
        if point_head and model.config.point_head is None:
            raise InputError(f"{path}: the model has no point head; convert VGGT with point_head, or leave it out")
    else:
        with open_state_dict(path) as state_dict, _naming(path):
            config = config_from_vggt(state_dict, point_head=point_head)
            model, variables = LogVGGT(config), {"params": params_from_vggt(state_dict, config)[0]}
    if dtype is not None:
        model = LogVGGT(dataclasses.replace(model.config, dtype=dtype))
    return model, variables


def convert(
    source: str | Path,
    destination: str | Path,
    *,
    point_head: bool = False,
    overwrite: bool = False,
    trained_for: Literal["vggt", "causal"] = "vggt",
) -> ConversionReport:
    """Writes a VGGT checkpoint (as `open_state_dict` reads it, or a hub repository) as a model folder that computes the
    same as VGGT. StreamVGGT's checkpoints have VGGT's names and shapes: `trained_for` records which of the two it is.

    Shows progress, the sizes that were found and the space that the folder needs on standard error; prints how many
    names were used, skipped and initialised once all is written, and returns them. `point_head` keeps the point head.
    The destination is looked at before the source. Raises OutputExists where there is something at the destination,
    unless it is a model folder and `overwrite` is set; DiskError where the space does not suffice; InputError as
    `from_pretrained`. Nothing is left behind, and an older model folder goes once the new one is complete.
    """
    destination = check_output(destination, overwrite=overwrite, kind=_MODEL_FOLDER)
    check_destination(destination)
    check_writable(destination)
    path, progress_console = resolve(source), Console(stderr=True)
    check_apart(destination, [path])
    if path.is_dir() and is_model_folder(path):
        raise InputError(f"{path}: is a model folder already, there is nothing to convert")
    with open_state_dict(path) as state_dict, _naming(path):
        config = config_from_vggt(state_dict, point_head=point_head)
        needed = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(parameter_shapes(config)))
        progress_console.print(
            _sizes(config),
            f"the folder takes {check_space(destination, needed)}",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
        with Progress(console=progress_console, transient=True) as progress:
            task = progress.add_task("Reading tensors", total=len(vggt_rules(config)))

            def read(name: str) -> np.ndarray:
                progress.advance(task)
                return state_dict[name]

            params, report = params_from_vggt(LazyTensors(list(state_dict), read, header=state_dict.header), config)
    with progress_console.status("Writing the model folder"):
        save_model(destination, config, params, _vggt_provenance(source, trained_for), replace=overwrite)
    Console().print(
        f"{path}: {len(report.used)} tensors used, {len(report.skipped)} skipped, "
        f"{len(report.initialised)} parameters initialised",
        soft_wrap=True,
        markup=False,
    )
    return report


def _sizes(config: ModelConfig) -> str:
    """What shapes and names told, so that a file with fewer blocks than its owner thinks does not go unnoticed."""
    return (
        f"encoder of {config.encoder.depth} blocks and width {config.encoder.embed_dim}, aggregator of "
        f"{config.aggregator.depth} + {config.aggregator.depth} blocks, camera head of {config.camera_head.depth};"
    )


def _vggt_provenance(source: str | Path, trained_for: Literal["vggt", "causal"] = "vggt") -> Provenance:
    address = hub_address(source)
    terms = None if address is None else licence(address[0])
    kind = {"vggt": "VGGT", "causal": "StreamVGGT"}[trained_for]
    return Provenance(trained_for, _VGGT_LONGER_EDGE, terms, f"{kind} checkpoint {source}")


def _reader() -> ocp.StandardCheckpointer:
    return ocp.StandardCheckpointer(multiprocessing_options=_alone(), restore_concurrent_gb=_GB_IN_FLIGHT)


def _alone() -> ocp.options.MultiprocessingOptions:
    """A model folder is one process's own affair, whoever else trains with it."""
    return ocp.options.MultiprocessingOptions(
        primary_host=jax.process_index(),
        active_processes={jax.process_index()},
        barrier_sync_key_prefix=f"model_of_process_{jax.process_index()}",
    )


def _restore(folder: Path, target: Any) -> Any:
    """Parameters in the shapes of `target` on the host, after a check that these are the stored shapes."""
    path = folder / "params"
    if not path.is_dir():
        raise MissingInput(f"{path}: the parameters are missing; {MEND}")

    def read() -> Any:
        check_regular_files(path)
        with as_it_is_named(path) as where, _reader() as checkpointer:
            stored = checkpointer.metadata(where).item_metadata
        if stored is None:
            raise FileNotFoundError("Orbax's description of the parameters is missing")
        if wrong := first_misfit(stored.tree, target, "the configuration in config.json"):
            raise InputError(f"{path}: {wrong}; the two belong to different models")
        # Arrays of one entry, seen in their shape: Orbax reads to where its target is, and gives numpy for numpy.
        on_host = jax.tree.map(lambda leaf: np.broadcast_to(np.zeros((), leaf.dtype), leaf.shape), target)
        return read_arrays(path, on_host)

    return read_with_orbax(read, f"{path}:", MEND)


def _restore_rounded(folder: Path, target: Any) -> Any:
    """As `_restore`, from one file at 16 bits."""
    stored = read_parameters(folder)
    if wrong := first_misfit(stored, target, "the configuration in config.json"):
        raise InputError(f"{folder / PARAMETERS_FILE}: {wrong}; the two belong to different models")
    leaves = [stored[name] for name, _ in named_leaves(target)]
    return jax.tree.unflatten(jax.tree.structure(target), leaves)


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
        # Of the disk, or of a file inside of a folder.
        if isinstance(error, OSError) or str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {error}") from error
