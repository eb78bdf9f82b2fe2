"""One checkpoint on the disk.

<step>/params/            parameters, in Orbax's format
<step>/state/             the rest of the state, likewise
<step>/data/metadata      where the data stand, JSON
<step>/meta/metadata      step, stage, configuration, versions of libraries; a digest of every leaf, since Orbax does
                          not notice flipped bytes, and one of the two JSON files
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import NamedSharding, PartitionSpec

from logvggt_jax.compile import out_of_device_memory
from logvggt_jax.errors import InputError, disk_errors, one_line
from logvggt_jax.files import atomic_folder, to_disk
from logvggt_jax.model.parameters import is_stack, stack_layers, unstack_layers
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.weights.checkpoints import read_arrays, write_arrays
from logvggt_jax.weights.digests import digests, json_digest, verify_digests
from logvggt_jax.weights.orbax_writing import writing_with_orbax

LIBRARIES = ("logvggt-jax", "jax", "flax", "optax", "orbax-checkpoint", "grain")
_ENTRIES = {"step", "stage", "layers", "config", "digests", "libraries", "digest"}


class DamagedCheckpoint(InputError):
    """A checkpoint cannot be read, or is not what was written."""


class Position(NamedTuple):
    """Where a run stands: its stage (by number) and the state of that stage's data stream (JSON types)."""

    stage: int
    data: dict[str, Any]


def write_checkpoint(folder: Path, state: TrainState, position: Position, config: TrainConfig) -> None:
    """Writes `state`, arrays on this host, as the checkpoint `folder`; replaces an older one.

    It appears under its name only when all of it is on the disk. Raises DiskError where it cannot be written.
    """
    params, rest = _parts(state)
    meta: dict[str, Any] = {
        "step": int(state.step),
        "stage": position.stage,
        "layers": "stacked",
        "config": config.to_dict(),
        "digests": {"params": digests(params), "state": digests(rest)},
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }
    meta["digest"] = json_digest([meta, position.data])
    with writing_with_orbax(folder), atomic_folder(folder, replace=True) as fresh:
        write_arrays(fresh / "params", params)
        write_arrays(fresh / "state", rest)
        for name, content in (("data", position.data), ("meta", meta)):
            (fresh / name).mkdir()
            (fresh / name / "metadata").write_text(json.dumps(content))
        to_disk([*fresh.rglob("*"), fresh])
    # Its name too, before older checkpoints go: a machine may lose its power in between.
    with disk_errors(folder):
        to_disk([folder.parent])


class StoredCheckpoint:
    """A checkpoint's description, read and compared with its digest; arrays are read later.

    Attributes:
      step: steps that were done.
      position: where the run stood.
      config: the run's settings, as mappings.
    """

    def __init__(self, folder: Path) -> None:
        """Raises DamagedCheckpoint naming the step and what is wrong."""
        self.where = f"checkpoint of step {folder.name} in {folder}"
        self._folder = folder
        with self._damage():
            data, meta = (json.loads((folder / part / "metadata").read_text()) for part in ("data", "meta"))
            # An entry of another name may have been `digest` before a bit of it was flipped.
            names = set(meta) if isinstance(meta, dict) else set()
            if not _ENTRIES - {"layers", "digest"} <= names <= _ENTRIES:
                raise InputError(f"{self.where} is damaged: it holds {sorted(names)}, expected {sorted(_ENTRIES)}")
            # Checkpoints of before there was a digest pass as they are.
            if "digest" in names:
                found = json_digest([{name: value for name, value in meta.items() if name != "digest"}, data])
                if found != meta["digest"]:
                    raise InputError(f"{self.where} is damaged: position and settings differ from their digest")
            self._digests: Mapping[str, Any] = meta["digests"]
            # Earlier versions kept the layers of some stacks, or of all, by themselves.
            self._stacks = {part for name in self._digests["params"] for part in name.split("/") if is_stack(part)}
        self.step, self.position, self.config = meta["step"], Position(meta["stage"], data), meta["config"]

    def read(self, like: TrainState, config: TrainConfig) -> TrainState:
        """The state with the shapes and placement of `like`; its content is not compared yet.

        Raises DamagedCheckpoint where it cannot be read.
        """
        params, rest = _parts(unstack_layers(like, config.model, _one_layer, kept=self._stacks))
        parts = {"params": params, "state": rest}
        with self._damage():
            read = {name: read_arrays(self._folder / name, _abstract(tree)) for name, tree in parts.items()}
        return TrainState(params=read["params"], **read["state"])

    def verified(self, state: TrainState) -> TrainState:
        """What `read` gave, after comparison with the digests, its layers stacked.

        Raises DamagedCheckpoint naming the leaf that differs. Where several processes hold parts of the state, all of
        them have to call this at the same point.
        """
        for name, tree in zip(("params", "state"), _parts(state), strict=True):
            with self._damage():
                verify_digests(tree, self._digests[name], self.where, mend="it is damaged")
        return stack_layers(state)

    @contextlib.contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except InputError as error:
            raise DamagedCheckpoint(str(error)) from error
        except MemoryError:
            raise
        except Exception as error:
            # What the machine lacks is no fault of the checkpoint.
            if isinstance(error, jax.errors.JaxRuntimeError) and out_of_device_memory(error):
                raise
            reason = f"{type(error).__name__}: {one_line(error):.200}"
            raise DamagedCheckpoint(f"{self.where} cannot be read ({reason})") from error


def _parts(state: TrainState) -> tuple[Any, dict[str, Any]]:
    rest = state._asdict()
    if state.average is None:  # Runs without one have checkpoints that older versions read.
        rest.pop("average")
    return rest.pop("params"), rest


def _one_layer(stack: jax.ShapeDtypeStruct, layer: int) -> jax.ShapeDtypeStruct:
    del layer
    sharding = stack.sharding
    if isinstance(sharding, NamedSharding):
        sharding = NamedSharding(sharding.mesh, PartitionSpec(*sharding.spec[1:]))
    return jax.ShapeDtypeStruct(stack.shape[1:], stack.dtype, sharding=sharding)


def _abstract(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), tree)
