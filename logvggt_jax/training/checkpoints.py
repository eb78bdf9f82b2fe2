"""Checkpoints from which a run goes on as if it had not stopped."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import orbax.checkpoint as ocp

from logvggt_jax.errors import InputError, OutputExists
from logvggt_jax.model.parameters import stack_layers, unstack_layers
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.processes import any_process
from logvggt_jax.training.state import TrainState
from logvggt_jax.weights.checkpoints import (
    check_destination,
    read_provenance,
    read_with_orbax,
    save_model,
    writing_with_orbax,
)
from logvggt_jax.weights.digests import digests, json_digest, verify_digests
from logvggt_jax.weights.folder import is_model_folder
from logvggt_jax.weights.provenance import Provenance, TrainingRecord

# How fast, from where and with how many broken clips the data come; the data stream checks that they are the same.
FREE_DATA_SETTINGS = ("worker_count", "num_threads", "cache_dir", "max_broken")
LIBRARIES = ("logvggt-jax", "jax", "flax", "optax", "orbax-checkpoint", "grain")


class Position(NamedTuple):
    """Where a run stands: its stage (by number) and the state of that stage's data stream (JSON types)."""

    stage: int
    data: dict[str, Any]


class RunCheckpoints:
    """The checkpoints `<workdir>/checkpoints/<step>` and the model folder `<workdir>/model`; a context manager.

    A checkpoint holds parameters, the rest of the state, the data stream's state, and the configuration, with a
    digest of every leaf and of the other two, since Orbax does not notice flipped bytes. It appears under its name only
    when complete. A model folder that another run or a conversion wrote is never replaced: OutputExists.
    """

    def __init__(self, workdir: Path, config: TrainConfig) -> None:
        self.config = config
        self.folder = workdir.expanduser().absolute() / "checkpoints"
        self.model_folder = self.folder.parent / "model"
        # Now rather than after the steps before the first save.
        check_destination(self.model_folder)
        self._check_own()
        # Saving is synchronous: the next step is given the state's buffers to overwrite.
        options = ocp.CheckpointManagerOptions(
            max_to_keep=config.keep_checkpoints, create=True, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def __enter__(self) -> RunCheckpoints:
        return self

    def __exit__(self, *_: Any) -> None:
        self._manager.close()

    @property
    def steps(self) -> list[int]:
        """Steps that have a complete checkpoint, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, state: TrainState, position: Position) -> None:
        """Replaces the model folder and writes the checkpoint of `state.step`."""
        step = int(state.step)
        params, rest = _parts(state)
        # First, so that a run that is killed in between goes on from an older checkpoint and writes both again.
        failure: Exception | None = None
        if jax.process_index() == 0:
            try:
                layers = unstack_layers(jax.device_get(params), self.config.model)
                save_model(self.model_folder, self.config.model, layers, self._provenance(step))
            except Exception as error:
                failure = error
        # The others would wait for the first one in the checkpoint below.
        if any_process(failure is not None):
            raise failure or OSError(f"process 0 could not write {self.model_folder}; its output says why")
        meta: dict[str, Any] = {
            "step": step,
            "stage": position.stage,
            "layers": "stacked",
            "config": self.config.to_dict(),
            "digests": {"params": digests(params), "state": digests(rest)},
            "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
        }
        meta["digest"] = json_digest([meta, position.data])
        with writing_with_orbax(self.folder / str(step)):
            self._manager.save(
                step,
                args=ocp.args.Composite(
                    params=ocp.args.StandardSave(params),
                    state=ocp.args.StandardSave(rest),
                    data=ocp.args.JsonSave(position.data),
                    meta=ocp.args.JsonSave(meta),
                ),
                force=True,
            )

    def _check_own(self) -> None:
        """A model without checkpoints is this run's if it was killed before its first one was complete."""
        if any(entry.name.isdecimal() for entry in self.folder.glob("*")) or not is_model_folder(self.model_folder):
            return
        source = read_provenance(self.model_folder).source or "source not recorded"
        if not source.endswith(self._here()):
            raise OutputExists(
                f"{self.model_folder}: a model that this run did not write ({source}) would be replaced; start in "
                "another --workdir or move it away"
            )

    def _here(self) -> str:
        return f" in {self.folder.parent}"

    def _provenance(self, step: int) -> Provenance:
        longer_edge = max(max(size) for stage in self.config.stages for size in stage.sizes)
        start = self.config.initial_weights or "random parameters"
        record = TrainingRecord(
            configuration=self.config.to_dict(),
            data=", ".join(f"{source.name} ({source.split})" for source in self.config.data.sources),
            steps=step,
            device=f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        )
        return Provenance("windows", longer_edge, source=f"trained from {start}{self._here()}", training=record)

    def restore(self, like: TrainState, *, step: int | None = None) -> tuple[TrainState, Position]:
        """The state at `step` (None: the latest), with the shapes and placement of `like`.

        Checkpoints of later steps are removed: the run that goes on from here will write its own. Raises InputError
        naming step, path and the other steps there are: no such checkpoint, one of another configuration, or a damaged
        one.
        """
        steps = self.steps
        chosen = step if step is not None else (steps[-1] if steps else None)
        if chosen is None or chosen not in steps:
            raise InputError(f"{self.folder}: no checkpoint of step {chosen}; there are {steps or 'none'}")
        where = f"checkpoint of step {chosen} in {self.folder / str(chosen)}"
        others = [other for other in steps if other != chosen]
        mend = f"resume from another with --resume_step (there are {others})" if others else "start a new --workdir"
        described = ocp.args.Composite(meta=ocp.args.JsonRestore(), data=ocp.args.JsonRestore())
        stored = self._read(chosen, described, where, mend)
        meta, data = stored["meta"], stored["data"]
        _check_description(meta, data, where, mend)
        self._check_configuration(meta["config"], where)
        # Earlier versions kept every layer's parameters and moments by themselves.
        layer_by_layer = meta.get("layers") != "stacked"
        if layer_by_layer:
            like = unstack_layers(like, self.config.model, _one_layer)
        params, rest = _parts(like)
        restored = self._read(
            chosen,
            ocp.args.Composite(
                params=ocp.args.StandardRestore(_abstract(params)),
                state=ocp.args.StandardRestore(_abstract(rest)),
            ),
            where,
            mend,
        )
        try:
            for part in ("params", "state"):
                verify_digests(restored[part], meta["digests"][part], where)
        except ValueError as error:
            raise InputError(f"{error}; {mend}") from error
        for later in steps:
            if later > chosen:
                self._manager.delete(later)
        state = TrainState(params=restored["params"], **restored["state"])
        return stack_layers(state) if layer_by_layer else state, Position(meta["stage"], data)

    def _read(self, step: int, args: Any, where: str, mend: str) -> Mapping[str, Any]:
        return read_with_orbax(lambda: self._manager.restore(step, args=args), where, mend)

    def _check_configuration(self, stored: Mapping[str, Any], where: str) -> None:
        ours = self.config.to_dict()
        for part in ("model", "stages", "data", "loss", "optimizer", "seed"):
            theirs = stored.get(part)
            if part == "data" and theirs is not None:
                theirs, ours[part] = _what_decides_clips(theirs), _what_decides_clips(ours[part])
            difference = _first_difference(theirs, ours[part], part)
            if difference is not None:
                name, theirs, mine = difference
                raise InputError(
                    f"{where} was written with {name}={theirs!r}, the configuration says {mine!r}; "
                    "set it back or start a new --workdir"
                )


def _check_description(meta: Any, data: Any, where: str, mend: str) -> None:
    """Compares position and settings with their digest; checkpoints of before there was one pass as they are."""
    known = {"step", "stage", "layers", "config", "digests", "libraries", "digest"}
    # An entry of another name may have been `digest` before a bit of it was flipped.
    names = set(meta) if isinstance(meta, dict) else set()
    if not known - {"layers", "digest"} <= names <= known:
        raise InputError(f"{where} is damaged: it holds {sorted(names)}, expected {sorted(known)}; {mend}")
    if "digest" in names:
        found = json_digest([{name: value for name, value in meta.items() if name != "digest"}, data])
        if found != meta["digest"]:
            raise InputError(f"{where} is damaged: position and settings differ from their digest; {mend}")


def _what_decides_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """The data settings without those that a run may change when it goes on: its clips stay the same."""
    kept = {name: value for name, value in data.items() if name not in FREE_DATA_SETTINGS}
    kept["sources"] = [{name: value for name, value in source.items() if name != "root"} for source in data["sources"]]
    return kept


def _parts(state: TrainState) -> tuple[Any, dict[str, Any]]:
    rest = state._asdict()
    return rest.pop("params"), rest


def _one_layer(stack: jax.ShapeDtypeStruct, layer: int) -> jax.ShapeDtypeStruct:
    del layer
    return jax.ShapeDtypeStruct(stack.shape[1:], stack.dtype, sharding=stack.sharding)


def _abstract(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), tree)


def _first_difference(theirs: Any, ours: Any, name: str) -> tuple[str, Any, Any] | None:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted(theirs.keys() | ours.keys()):
            found = _first_difference(theirs.get(key), ours.get(key), f"{name}.{key}")
            if found is not None:
                return found
        return None
    if isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        for i, (a, b) in enumerate(zip(theirs, ours, strict=True)):
            found = _first_difference(a, b, f"{name}[{i}]")
            if found is not None:
                return found
        return None
    return None if theirs == ours else (name, theirs, ours)
