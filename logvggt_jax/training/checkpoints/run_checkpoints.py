"""Checkpoints from which a run goes on as if it had not stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import logging

from logvggt_jax.errors import DiskError, InputError, disk_errors, one_line
from logvggt_jax.files import FolderLock, check_space, write_text
from logvggt_jax.training.checkpoints.checkpoint_files import (
    DamagedCheckpoint,
    Position,
    StoredCheckpoint,
    write_checkpoint,
)
from logvggt_jax.training.checkpoints.run_models import RunModels
from logvggt_jax.training.checkpoints.same_run import check_configuration
from logvggt_jax.training.checkpoints.work_folder import remove_scratch
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.agreement import any_process
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.weights.digests import is_divided, whole_array

_BEGIN_ANEW = "start a new --workdir"
_ELSEWHERE = "start in another --workdir; processes of one run are started with --distributed"


class RunCheckpoints:
    """The checkpoints `<workdir>/checkpoints/<step>` and the model folders `<workdir>/model` and `<workdir>/best`; a
    context manager.

    While entered, the folder is this run's alone. Saves are written in the background, by process 0. A checkpoint
    appears under its name only when complete, see `checkpoint_files`. What `restore` passes over stays, under the name
    `<step>.aside`. A model folder that another run or a conversion wrote is never replaced: OutputExists.
    """

    def __init__(self, workdir: Path, config: TrainConfig, *, trained_on: Collection[str] | None = None) -> None:
        """Args: `trained_on`: see `RunModels`."""
        self.config = config
        self.folder = workdir.absolute() / "checkpoints"
        self.models = RunModels(self.folder.parent, config, trained_on)
        self._honoured = self.folder / "resumed.json"
        self._lock: FolderLock | None = None
        self._writer = ThreadPoolExecutor(1, "checkpoints")
        self._pending: list[Future[None]] = []
        # Steps of the last save and of the last best model, on their way or done.
        self._saved: int | None = None
        self._best: int | None = None
        # A model without checkpoints is this run's if it was killed before its first one was complete.
        if self.steps:
            self.models.check_replaceable()
        else:
            self.models.check_own()

    def __enter__(self) -> RunCheckpoints:
        """Raises InputError, on every process, where another run uses the folder or process 0 cannot."""
        failure: InputError | None = None
        if jax.process_index() == 0:
            try:
                self._lock = FolderLock(self.folder.parent, _ELSEWHERE)
                remove_scratch(self.folder.parent)
                self._set_damaged_models_aside()
            except InputError as error:
                failure = error
        if any_process(failure is not None):
            self.__exit__()
            raise failure or InputError(f"process 0 cannot use {self.folder.parent}; its output says why")
        return self

    def check_unused(self) -> None:
        """Raises InputError, on every process, where another run uses the folder now; makes none."""
        failure: InputError | None = None
        if jax.process_index() == 0 and self.folder.parent.is_dir():
            try:
                FolderLock(self.folder.parent, _ELSEWHERE).release()
            except InputError as error:
                failure = error
        if any_process(failure is not None):
            if isinstance(failure, DiskError):
                raise DiskError(
                    f"{failure}; with room again the same command goes on from the last checkpoint"
                ) from failure
            raise failure or InputError(f"process 0 cannot use {self.folder.parent}; its output says why")

    def __exit__(self, *_: Any) -> None:
        """Ends after the last save; whoever must know how it went calls `wait` before."""
        self._writer.shutdown(wait=True)
        for failure in filter(None, (saving.exception() for saving in self._pending)):
            logging.error("the last save failed: %s", one_line(failure))
        if self._lock is not None:
            self._lock.release()

    @property
    def steps(self) -> list[int]:
        """Steps that have a complete checkpoint, oldest first."""
        return sorted(int(entry.name) for entry in self.folder.glob("*") if entry.name.isdecimal())

    @property
    def best_step(self) -> int | None:
        """The step of the model in `best`, or of the one that is on its way there; None without either."""
        return self.models.best_step if self._best is None else self._best

    def save(self, state: TrainState, position: Position, *, in_place_of: int | None = None) -> None:
        """Begins to replace the model folder and to write the checkpoint of `state.step`, and returns.

        The state may be donated as soon as this returns: copies are on the host of process 0, once. Raises what kept
        the save before from being written, see `wait`. The checkpoint `in_place_of` goes when this one is complete.
        """
        self.wait()
        copies, self._saved = self._copied(state), int(state.step)
        self._begin(self._write, copies, position, in_place_of)

    def save_best(self, state: TrainState) -> None:
        """Begins to replace the model folder `best` by this state's parameters, and returns.

        Where the save before was of the same step, nothing is copied or written, nor is that save waited for: `best`
        gets the files of `model` after it. Otherwise as `save`.
        """
        self._best = step = int(state.step)
        if step == self._saved:
            self._begin(self._newest_is_best, step)
        else:
            self.wait()  # the host holds one save at a time
            self._begin(self._write_model, self.models.best, self._copied(state.averaged), step)

    def write_missing_model(self, state: TrainState) -> None:
        """Begins to write the model folder of a restored state where there is none, and returns; all processes have to
        call this at the same point."""
        if any_process(jax.process_index() == 0 and self.models.newest_step is None):
            self._begin(self._write_model, self.models.newest, self._copied(state.averaged), int(state.step))

    def check(self) -> None:
        """Raises on process 0 what kept a save from being written, as soon as that is known; waits for nothing."""
        for saving in self._pending:
            if saving.done():
                saving.result()

    def wait(self) -> None:
        """Returns when all saves are complete; raises on every process what kept process 0 from writing one.

        All processes have to call this at the same point.
        """
        pending, self._pending = self._pending, []
        failure = next(filter(None, [saving.exception() for saving in pending]), None)
        if any_process(failure is not None):
            if isinstance(failure, DiskError):
                raise DiskError(f"{failure}; once that is mended the same command goes on") from failure
            raise failure or DiskError(f"process 0 could not save to {self.folder}; its output says why")

    def _begin(self, write: Callable[..., None], *given: Any) -> None:
        """Has the writer do this after what it was given before, on process 0."""
        if jax.process_index() == 0:
            self._pending.append(self._writer.submit(write, *given))

    def restore(self, like: TrainState, *, step: int | None = None) -> tuple[TrainState, Position]:
        """The state at `step` (None: the latest that is not damaged), with the shapes and placement of `like`.

        A `step` is gone back to once: the same request of a command that is started again goes on from the latest.
        Checkpoints of later steps, and damaged ones, are moved aside, with a `best` model of a later step, and a
        warning says so.

        Raises InputError naming step, path and the other steps there are: no such checkpoint, one of another
        configuration, or DamagedCheckpoint where `step` is damaged or all are.
        """
        steps = self.steps
        candidates = self._candidates(steps, step)
        if step is not None and candidates != [step]:
            logging.warning(
                "--resume_step=%d was honoured before: going on from the latest; to go back once more, remove %s",
                step,
                self._honoured,
            )
            step = None
        for chosen in candidates:
            try:
                state, position = self._restore(chosen, like)
            except DamagedCheckpoint as error:
                if chosen == candidates[-1]:
                    raise _without_way_on(error, steps, candidates) from error
                logging.error("%s; going on from the checkpoint before it", one_line(error))
            else:
                break
        if jax.process_index() == 0:
            with disk_errors(self.folder):
                discarded = [other for other in steps if other > chosen]
                for later in discarded:
                    aside = _set_aside(self.folder / str(later))
                    logging.warning("the run goes on from step %d; that of step %d moved to %s", chosen, later, aside)
                best = self.models.best_step
                if discarded and best is not None and best > chosen:
                    aside = _set_aside(self.models.best)
                    logging.warning("the run goes on from step %d; best model, of %d, moved to %s", chosen, best, aside)
                if step is not None:
                    write_text(self._honoured, json.dumps({"resume_step": step}))
        return state, position

    def resumed_step(self, step: int | None = None) -> int | None:
        """The step that `restore` would go on from, as far as descriptions tell; None where a run begins anew.

        Raises InputError for a checkpoint that is not there, or of another configuration, and DamagedCheckpoint where
        no description can be read.
        """
        steps = self.steps
        if step is None and not any(steps):
            return None
        candidates = self._candidates(steps, step)
        for chosen in candidates:
            try:
                stored = StoredCheckpoint(self.folder / str(chosen))
            except DamagedCheckpoint as error:
                if chosen == candidates[-1]:
                    raise _without_way_on(error, steps, candidates) from error
                continue  # as a run does, which goes on from the one before
            check_configuration(stored, self.config)
            return chosen
        return None

    def _candidates(self, steps: list[int], step: int | None) -> list[int]:
        """Those of `steps` to go on from, the first that is whole: the one asked for alone, or the latest first."""
        if step is not None and steps and step == self._went_back_to():
            step = None
        if not steps or (step is not None and step not in steps):
            raise InputError(f"{self.folder}: no checkpoint of step {step}; there are {steps or 'none'}")
        return list(reversed(steps)) if step is None else [step]

    def begin_anew(self) -> None:
        """Takes away the `best` model of a start that was given up before its first save: aside where it had learned,
        for good where it is what that start began with."""
        step = self.models.best_step if jax.process_index() == 0 else None
        if step is None:
            return
        best = self.models.best
        with disk_errors(self.folder):
            if step > 0:
                logging.warning("the run begins anew; best model, of step %d, moved to %s", step, _set_aside(best))
                return
            # Under another name first, which `remove_scratch` knows: what is deleted by half is no model.
            leaving = best.rename(best.with_name(f"{best.name}.{step}.partial"))
        shutil.rmtree(leaving, ignore_errors=True)

    @staticmethod
    def _copied(tree: Any) -> Any:
        """Arrays on the host of process 0, nothing on the others; all have to call this at the same point."""
        writes = jax.process_index() == 0
        for leaf in jax.tree.leaves(tree):
            if writes and _is_fetched(leaf) and not is_divided(leaf):
                leaf.copy_to_host_async()  # all transfers at once

        def copied(leaf: Any) -> np.ndarray | None:
            if not (writes or is_divided(leaf)):
                return None
            whole = whole_array(leaf)
            if not writes:
                return None
            # On a CPU it could be the very memory that the next step writes to.
            return whole if _is_fetched(leaf) else np.array(whole)

        return jax.tree.map(copied, tree)

    def _restore(self, step: int, like: TrainState) -> tuple[TrainState, Position]:
        """Raises DamagedCheckpoint on every process where one of them finds damage."""
        problem: DamagedCheckpoint | None = None
        stored, state = None, like
        try:
            stored = StoredCheckpoint(self.folder / str(step))
            check_configuration(stored, self.config)
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
        self.models.write(self.models.newest, state.averaged, step)
        write_checkpoint(self.folder / str(step), state, position, self.config)
        newest = [kept for kept in self.steps if kept != in_place_of][-self.config.keep_checkpoints :]
        for old in {*self.steps} - {step, *newest}:
            # Under another name first: what is deleted by half must not look like a checkpoint.
            leaving = self.folder / f".{old}.old"
            (self.folder / str(old)).rename(leaving)
            shutil.rmtree(leaving, ignore_errors=True)

    def _newest_is_best(self, step: int) -> None:
        # It is not where its save has failed, as `wait` will say.
        if self.models.newest_step == step:
            self.models.keep_newest_as_best()

    def _write_model(self, folder: Path, params: Any, step: int) -> None:
        _check_room(folder, params)
        self.models.write(folder, params, step)

    def _set_damaged_models_aside(self) -> None:
        # Without a checkpoint it may be another's.
        for folder, problem in self.models.damaged if self.steps else ():
            with disk_errors(folder):
                logging.error("%s is damaged (%s); moved to %s", folder, one_line(problem), _set_aside(folder))

    def _went_back_to(self) -> int | None:
        """The step that an earlier start of this run was told to go back to, and did."""
        try:
            found: int | None = json.loads(self._honoured.read_text())["resume_step"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None
        return found


def _without_way_on(error: DamagedCheckpoint, steps: list[int], tried: list[int]) -> DamagedCheckpoint:
    """The error, and what is left to do."""
    others = [step for step in steps if step not in tried]
    mend = f"resume from another with --resume_step (there are {others})" if others else _BEGIN_ANEW
    return DamagedCheckpoint(f"{error}; {mend}")


def _is_fetched(leaf: Any) -> bool:
    """Whether a leaf lies on devices with memory of their own, so that its numbers on the host are a copy."""
    return isinstance(leaf, jax.Array) and all(device.platform != "cpu" for device in leaf.devices())


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
