"""Checkpoints from which a run goes on as if it had not stopped."""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import logging

from logvggt_jax.errors import DiskError, InputError, OutputExists, disk_errors, one_line
from logvggt_jax.files import FolderLock, check_space, write_text
from logvggt_jax.model.parameters import unstack_layers
from logvggt_jax.training.checkpoints.checkpoint_files import (
    DamagedCheckpoint,
    Position,
    StoredCheckpoint,
    write_checkpoint,
)
from logvggt_jax.training.checkpoints.work_folder import remove_scratch
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.joining import any_process
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.weights.checkpoints import check_destination, read_licence, read_provenance, save_model
from logvggt_jax.weights.digests import whole_array
from logvggt_jax.weights.folder import is_model_folder
from logvggt_jax.weights.provenance import Provenance, TrainingRecord

# How fast, from where and with how many broken clips the data come; the data stream checks that they are the same.
FREE_DATA_SETTINGS = ("worker_count", "num_threads", "cache_dir", "max_broken")


class RunCheckpoints:
    """The checkpoints `<workdir>/checkpoints/<step>` and the model folders `<workdir>/model` and `<workdir>/best`; a
    context manager.

    While entered, the folder is this run's alone. Saves are written in the background, by process 0. A checkpoint
    appears under its name only when complete, see `checkpoint_files`. What `restore` passes over stays, under the name
    `<step>.aside`. A model folder that another run or a conversion wrote is never replaced: OutputExists.
    """

    def __init__(self, workdir: Path, config: TrainConfig) -> None:
        self.config = config
        self.folder = workdir.expanduser().absolute() / "checkpoints"
        self.model_folder, self.best_folder = self.folder.parent / "model", self.folder.parent / "best"
        self._honoured = self.folder / "resumed.json"
        self._lock: FolderLock | None = None
        self._writer = ThreadPoolExecutor(1, "checkpoints")
        self._pending: Future[None] | None = None
        # Now rather than after the steps before the first save.
        for folder in (self.model_folder, self.best_folder):
            check_destination(folder)
        self._check_own()

    def __enter__(self) -> RunCheckpoints:
        """Raises InputError where another run uses the folder."""
        if jax.process_index() == 0:
            self._lock = FolderLock(self.folder.parent, "start in another --workdir")
            remove_scratch(self.folder.parent)
        return self

    def __exit__(self, *_: Any) -> None:
        """Ends after the last save; whoever must know how it went calls `wait` before."""
        self._writer.shutdown(wait=True)
        if self._pending is not None and (failure := self._pending.exception()) is not None:
            logging.error("the last save failed: %s", one_line(failure))
        if self._lock is not None:
            self._lock.release()

    @property
    def steps(self) -> list[int]:
        """Steps that have a complete checkpoint, oldest first."""
        return sorted(int(entry.name) for entry in self.folder.glob("*") if entry.name.isdecimal())

    def save(self, state: TrainState, position: Position, *, in_place_of: int | None = None) -> None:
        """Begins to replace the model folder and to write the checkpoint of `state.step`, and returns.

        The state may be donated as soon as this returns: copies are on the host of process 0, once. Raises what kept
        the save before from being written, see `wait`. The checkpoint `in_place_of` goes when this one is complete.
        """
        self.wait()
        copies = self._copied(state)
        if jax.process_index() == 0:
            self._pending = self._writer.submit(self._write, copies, position, in_place_of)

    def save_best(self, state: TrainState) -> None:
        """Begins to replace the model folder `best` by this state's parameters, and returns; as `save`."""
        self.wait()
        params, step = self._copied(state.averaged), int(state.step)
        if jax.process_index() == 0:
            self._pending = self._writer.submit(self._write_best, params, step)

    @property
    def best_step(self) -> int | None:
        """The step of the model in `best`; None without one."""
        record = read_provenance(self.best_folder).training if is_model_folder(self.best_folder) else None
        return None if record is None else record.steps

    def check(self) -> None:
        """Raises on process 0 what kept a save from being written, as soon as that is known; waits for nothing."""
        if self._pending is not None and self._pending.done() and self._pending.exception() is not None:
            self._pending.result()

    def wait(self) -> None:
        """Returns when the last save is complete; raises on every process what kept process 0 from writing it.

        All processes have to call this at the same point.
        """
        pending, self._pending = self._pending, None
        failure = None if pending is None else pending.exception()
        if any_process(failure is not None):
            raise failure or DiskError(f"process 0 could not save to {self.folder}; its output says why")

    def restore(self, like: TrainState, *, step: int | None = None) -> tuple[TrainState, Position]:
        """The state at `step` (None: the latest that is not damaged), with the shapes and placement of `like`.

        A `step` is gone back to once: the same request of a command that is started again goes on from the latest.
        Checkpoints of later steps, and damaged ones, are moved aside, with a `best` model of a later step, and a
        warning says so.

        Raises InputError naming step, path and the other steps there are: no such checkpoint, one of another
        configuration, or DamagedCheckpoint where `step` is damaged or all are.
        """
        steps = self.steps
        if step is not None and step == self._went_back_to() and steps:
            logging.warning(
                "--resume_step=%d was honoured before: going on from the latest; to go back once more, remove %s",
                step,
                self._honoured,
            )
            step = None
        if not steps or (step is not None and step not in steps):
            raise InputError(f"{self.folder}: no checkpoint of step {step}; there are {steps or 'none'}")
        candidates = list(reversed(steps)) if step is None else [step]
        for chosen in candidates:
            try:
                state, position = self._restore(chosen, like)
            except DamagedCheckpoint as error:
                others = [other for other in steps if other != chosen] if step is not None else []
                mend = (
                    f"resume from another with --resume_step (there are {others})"
                    if others
                    else "start a new --workdir"
                )
                if chosen == candidates[-1]:
                    raise DamagedCheckpoint(f"{error}; {mend if others else 'start a new --workdir'}") from error
                logging.error("%s; going on from the checkpoint before it", one_line(error))
            else:
                break
        if jax.process_index() == 0:
            with disk_errors(self.folder):
                discarded = [other for other in steps if other > chosen]
                for later in discarded:
                    aside = _set_aside(self.folder / str(later))
                    logging.warning("the run goes on from step %d; that of step %d moved to %s", chosen, later, aside)
                best = self.best_step
                if discarded and best is not None and best > chosen:
                    aside = _set_aside(self.best_folder)
                    logging.warning("the run goes on from step %d; best model, of %d, moved to %s", chosen, best, aside)
                if step is not None:
                    write_text(self._honoured, json.dumps({"resume_step": step}))
        return state, position

    @staticmethod
    def _copied(tree: Any) -> Any:
        """Arrays on the host of process 0, nothing on the others; all have to call this at the same point."""

        def copied(leaf: Any) -> np.ndarray | None:
            whole = whole_array(leaf)
            # Always a copy: on a CPU it could be the very memory that the next step writes to.
            return np.array(whole) if jax.process_index() == 0 else None

        return jax.tree.map(copied, tree)

    def _restore(self, step: int, like: TrainState) -> tuple[TrainState, Position]:
        """Raises DamagedCheckpoint on every process where one of them finds damage."""
        problem: DamagedCheckpoint | None = None
        stored, state = None, like
        try:
            stored = StoredCheckpoint(self.folder / str(step))
            self._check_configuration(stored)
            state = stored.read(like, self.config)
        except DamagedCheckpoint as error:
            problem = error
        # Comparison needs all of them.
        if any_process(problem is not None) or stored is None:
            raise problem or DamagedCheckpoint(f"checkpoint of step {step} cannot be read by another process")
        try:
            state = stored.verified(state)
        except DamagedCheckpoint as error:
            problem = error
        if any_process(problem is not None):
            raise problem or DamagedCheckpoint(f"{stored.where} is damaged, as another process finds")
        return state, stored.position

    def _write(self, state: TrainState, position: Position, in_place_of: int | None) -> None:
        step = int(state.step)
        _check_room(self.folder / str(step), (state, state.averaged))
        # First, so that a run that is killed in between goes on from an older checkpoint and writes both again.
        self._write_model(self.model_folder, state.averaged, step)
        write_checkpoint(self.folder / str(step), state, position, self.config)
        newest = [kept for kept in self.steps if kept != in_place_of][-self.config.keep_checkpoints :]
        for old in {*self.steps} - {step, *newest}:
            # Under another name first: what is deleted by half must not look like a checkpoint.
            leaving = self.folder / f".{old}.old"
            (self.folder / str(old)).rename(leaving)
            shutil.rmtree(leaving, ignore_errors=True)

    def _write_best(self, params: Any, step: int) -> None:
        _check_room(self.best_folder, params)
        self._write_model(self.best_folder, params, step)

    def _write_model(self, folder: Path, params: Any, step: int) -> None:
        save_model(folder, self.config.model, unstack_layers(params, self.config.model), self._provenance(step))

    def _went_back_to(self) -> int | None:
        """The step that an earlier start of this run was told to go back to, and did."""
        try:
            found: int | None = json.loads(self._honoured.read_text())["resume_step"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None
        return found

    def _check_own(self) -> None:
        """A model without checkpoints is this run's if it was killed before its first one was complete."""
        if any(entry.name.isdecimal() for entry in self.folder.glob("*")):
            return
        for folder in filter(is_model_folder, (self.model_folder, self.best_folder)):
            source = read_provenance(folder).source or "source not recorded"
            if not source.endswith(self._here()):
                raise OutputExists(
                    f"{folder}: a model that this run did not write ({source}) would be replaced; start in another "
                    "--workdir or move it away"
                )

    def _here(self) -> str:
        return f" in {self.folder.parent}"

    @functools.cached_property
    def _licence(self) -> str | None:
        """Of the weights that the run started from and of its teacher's, which its own are made of, as far as known."""
        teacher = self.config.teacher
        found: list[str | None] = []
        # Either may be gone, or its hub out of reach, when a run goes on.
        for weights in (self.config.initial_weights, None if teacher is None else teacher.weights):
            with contextlib.suppress(InputError):
                found.append(None if weights is None else read_licence(weights))
        if terms := " and ".join(dict.fromkeys(filter(None, found))):
            return terms
        earlier = read_provenance(self.model_folder) if is_model_folder(self.model_folder) else Provenance()
        return earlier.licence if earlier.source == self._source else None

    @property
    def _source(self) -> str:
        return f"trained from {self.config.initial_weights or 'random parameters'}{self._here()}"

    def _provenance(self, step: int) -> Provenance:
        longer_edge = max(max(size) for stage in self.config.stages for size in stage.sizes)
        record = TrainingRecord(
            configuration=self.config.to_dict(),
            data=", ".join(f"{source.name} ({source.split})" for source in self.config.data.sources),
            steps=step,
            device=f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        )
        return Provenance("windows", longer_edge, self._licence, self._source, record)

    def _check_configuration(self, stored: StoredCheckpoint) -> None:
        ours, written = self.config.to_dict(), stored.config
        with contextlib.suppress(InputError):  # with what an earlier version had no field for
            # Validation may change, and is not to keep the rest from being read where its fields did.
            written = TrainConfig.from_dict({**written, "validation": None}).to_dict()
        for part in ("model", "stages", "data", "loss", "optimizer", "seed", "average"):
            theirs = written.get(part)
            if part == "data" and theirs is not None:
                theirs, ours[part] = _what_decides_clips(theirs), _what_decides_clips(ours[part])
            difference = _first_difference(theirs, ours[part], part)
            if difference is not None:
                name, theirs, mine = difference
                raise InputError(
                    f"{stored.where} was written with {name}={theirs!r}, the configuration says {mine!r}; "
                    "set it back or start a new --workdir"
                )


def _check_room(path: Path, tree: Any) -> None:
    """Raises DiskError where these arrays do not fit; the library that writes would say so in hundreds of lines."""
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
    check_space(path, needed, "make room, and the same command goes on from the last checkpoint")


def _set_aside(folder: Path) -> Path:
    """Gives a checkpoint or a model a name that no other has, under which it is none."""
    path, number = folder.with_name(f"{folder.name}.aside"), 1
    while path.exists():
        number += 1
        path = folder.with_name(f"{folder.name}.aside{number}")
    folder.rename(path)
    return path


def _what_decides_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """The data settings without those that a run may change when it goes on: its clips stay the same."""
    kept = {name: value for name, value in data.items() if name not in FREE_DATA_SETTINGS}
    kept["sources"] = [{name: value for name, value in source.items() if name != "root"} for source in data["sources"]]
    return kept


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
