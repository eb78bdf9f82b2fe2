"""The training loop: stages, logging, validation, checkpoints, and a clean end whatever ends it."""

import contextlib
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console

from logvggt_jax.compile import most_device_bytes
from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.batches import BatchIterator
from logvggt_jax.files import check_writable
from logvggt_jax.interruption import StopRequest
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.operations import matmul_flops_per_second
from logvggt_jax.training import steps_in_flight
from logvggt_jax.training.checkpoints.checkpoint_files import Position
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.config import StageConfig, TrainConfig
from logvggt_jax.training.feeding.batches import stage_batches, with_all_broken
from logvggt_jax.training.feeding.device_batches import DeviceBatches
from logvggt_jax.training.parallel.agreement import (
    Vote,
    any_process,
    check_agreement,
    check_shared,
    from_all,
    raise_together,
)
from logvggt_jax.training.parallel.same_settings import check_same_parameters, check_same_settings
from logvggt_jax.training.parallel.sharding import check_batch_size
from logvggt_jax.training.parallel.watchdog import Watchdog
from logvggt_jax.training.reporting.intervals import own_facts, report_interval
from logvggt_jax.training.reporting.metrics_log import MetricsLog, read_metrics
from logvggt_jax.training.reporting.profile import ProfiledSteps, Profiler
from logvggt_jax.training.reporting.progress import duration, goodput
from logvggt_jax.training.reporting.run_times import RunTimes
from logvggt_jax.training.reporting.wandb_run import WandbRun, load_wandb
from logvggt_jax.training.step.compilation import compiled_steps
from logvggt_jax.training.step.costs import step_flops
from logvggt_jax.training.step.device_memory import memory_explained, validation_memory_explained
from logvggt_jax.training.step.finite_check import non_finite_clips
from logvggt_jax.training.step.freezing import frozen_patterns
from logvggt_jax.training.step.initialization import check_weights, initial_parameters
from logvggt_jax.training.step.program import Program, abstract_parameters, make_program
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.training.step.train_step import Batch
from logvggt_jax.training.steps_in_flight import StepsInFlight
from logvggt_jax.training.teaching.run_data import open_data
from logvggt_jax.training.validation.earlier import VALIDATION_SET, is_best, validation_digest, validation_of
from logvggt_jax.training.validation.validation import Validation, validation_line
from logvggt_jax.weights.address import hub_address

# Of a process, in words.
NO_CLIPS = "can read no more clips"


class NonFiniteTraining(RuntimeError):
    """Too many updates in a row had a non-finite loss or gradient."""


def train(
    config: TrainConfig,
    workdir: Path,
    *,
    mesh: Mesh,
    resume_step: int | None = None,
    watchdog: float = 0.0,
    profile: ProfiledSteps | None = None,
    wandb: str | None = None,
) -> TrainState:
    """Runs the stages of `config` on `mesh`, or what is left of them if `workdir` holds a checkpoint; the state at the
    end.

    Leaves `checkpoints/`, `model/` (for `load_model`), the `best/` model by a metric of validation, `metrics.jsonl`,
    `times.jsonl`, `tensorboard/` and a `profile/` that was asked for in `workdir`; `wandb` names a project of Weights &
    Biases that shows the same. SIGTERM, Ctrl-C and `config.max_minutes` end the run after the current step with a
    checkpoint; `resume_step` is the one to go on from, once, None takes the latest. A run begins with a save and a
    validation, so that either fails at once. When no step has ended for `watchdog` times the median step the process
    ends, see `Watchdog`.

    Raises InputError for settings, data or a checkpoint that do not fit, in one line, and NonFiniteTraining where
    `config.max_skipped_in_a_row` updates in a row were not finite; a run that is started again goes on past them. Where
    a process can read no more clips all of them save first; it raises what kept it from reading, the others
    EndedElsewhere.
    """
    for stage in config.stages:
        check_batch_size(stage, mesh, accumulate=config.accumulate)
    if wandb is not None:
        load_wandb()
    if jax.process_index() == 0:  # which alone writes there
        check_writable(workdir.absolute() / "checkpoints")
    check_shared(workdir)
    check_same_settings(config, profile=profile, resume_step=resume_step)
    with contextlib.ExitStack() as stack:
        earlier = RunCheckpoints(workdir, config)
        earlier.check_unused()
        # What can be refused without data is, before they are drawn or labelled: checkpoints, names of parameters, and
        # weights at hand, which a run that goes on needs no more.
        begins = earlier.resumed_step(resume_step) is None
        program = make_program(LogVGGT(config.model), config, abstract_parameters(config.model), mesh)
        if begins and config.initial_weights is not None and hub_address(config.initial_weights) is None:
            check_weights(config.model, config.initial_weights)
        # Before gigabytes of weights are read, and unwatched: to label all clips, or to list a disk, takes hours.
        datasets, validated = open_data(config)
        watched = stack.enter_context(Watchdog(watchdog))
        run = _Run(config, workdir, program, watched, validated, trained_on=datasets)
        run.profiler = stack.enter_context(Profiler(profile, workdir / "profile"))
        stack.enter_context(run.checkpoints)
        stop = stack.enter_context(StopRequest("SIGTERM", "SIGINT"))
        first, position = run.start(resume_step)
        check_agreement("the checkpoints", first)
        silent = jax.process_index() != 0
        tracked = None
        if wandb is not None and not silent:
            tracked = stack.enter_context(WandbRun(wandb, workdir, config.to_dict()))
        with MetricsLog(
            workdir, first_step=first, anew=position is None, console=Console(), silent=silent, wandb=tracked
        ) as log:
            log.say(f"{mesh.size} devices, {first}/{config.total_steps} steps done, results in {workdir}")
            run.train(datasets, position, log, stop)
    return run.state


class _Run:
    """The parts of one run and its current state."""

    state: TrainState
    times: RunTimes
    in_flight: StepsInFlight
    profiler: Profiler
    validation_set: str

    def __init__(
        self,
        config: TrainConfig,
        workdir: Path,
        program: Program,
        watchdog: Watchdog,
        validated: Sequence[Dataset],
        *,
        trained_on: Collection[str],
    ) -> None:
        layout = program.layout
        self.config, self.program, self.mesh, self.watchdog = config, program, layout.mesh, watchdog
        self.deadline = None if config.max_minutes is None else time.monotonic() + 60 * config.max_minutes
        self.programs: dict[tuple[int, ...], jax.stages.Compiled] = {}
        self.operations: dict[tuple[int, ...], float] = {}
        self.validation = None
        if config.validation is not None:
            self.validation = Validation(LogVGGT(config.model), config.validation, layout, validated)
            self.validation_set = validation_digest(config, validated)
        self.checkpoints = RunCheckpoints(workdir, config, trained_on=trained_on)
        self.peak = _peak(layout.mesh, config.model.dtype)
        self.vote = Vote(layout.mesh, delay=steps_in_flight.MOST)

    def start(self, resume_step: int | None) -> tuple[int, Position | None]:
        """Takes up a checkpoint, or the initial weights if there is none.

        Returns the number of steps done and where the data stand.
        """
        config = self.config
        # The checkpoint of step 0 is there to show that one can be written: nothing is lost by beginning again.
        if resume_step is None and not any(self.checkpoints.steps):
            params = initial_parameters(config.model, seed=config.seed, weights=config.initial_weights)
            check_same_parameters(params)
            self.checkpoints.begin_anew()
            self.state = self.program.initial_state(params)
            return 0, None
        like = self.program.abstract_state
        self.state, position = self.checkpoints.restore(like, step=resume_step)
        self.checkpoints.write_missing_model(self.state)
        return int(self.state.step), position

    def train(
        self, datasets: Mapping[str, Dataset], position: Position | None, log: MetricsLog, stop: StopRequest
    ) -> None:
        """All stages that are not finished."""
        step, end = int(self.state.step), 0
        self.in_flight = StepsInFlight(
            skipped=int(self.state.skipped),
            in_a_row=int(self.state.skipped_in_a_row),
            step_ended=self.watchdog.step_ended,
            non_finite_clips=self._non_finite_clips,
        )
        self.times = RunTimes(self.config, productive=log.productive_seconds, costs=log.costs, peak=self.peak)
        left: list[tuple[int, StageConfig, int, BatchIterator]] = []
        # All of them at once: data that do not fit the last stage are an error of the first minute.
        for index, stage in enumerate(self.config.stages):
            end += stage.steps
            if step >= end:
                continue
            seed = self.config.seed * len(self.config.stages) + index
            begun = position.data if position is not None and position.stage == index else None
            source = stage_batches(datasets, self.config.data, stage, seed=seed, state=begun)
            if position is not None and begun is None:  # of a stage that is done, on the same sequences
                source.check_sources(position.data)
            # Otherwise they would wait for one another in different programs.
            check_agreement(f"stage {stage.name!r}: the data", {**source.get_state(), "broken": None})
            left.append((index, stage, end, source))
        if step == 0:
            self._save(Position(0, left[0][3].get_state()))
            self.checkpoints.wait()
        if self._validation_is_due(step):
            # After a save; the run may have been killed between the two, or before the best model was on the disk.
            found = None if log.silent else validation_of(read_metrics(log.path), step)
            if any_process(not log.silent and found is None):
                self._validate(step, log)
            else:
                known = found is not None and found.get(VALIDATION_SET) == self.validation_set
                self._keep_if_best(step, found if found is not None and known else {}, log)
        for index, stage, end, source in left:
            with (
                source,
                DeviceBatches(source, self.mesh, ahead=self.vote.notice + 1) as batches,
                memory_explained(stage, self.mesh, self.programs.values()),
            ):
                self._compile(stage, source.sizes, log)
                step, ended = self._train_stage(index, stage, batches, step, end, log, stop)
            if ended:
                break
        self.checkpoints.wait()
        log.say(
            f"{step}/{self.config.total_steps} steps done; model in {self.checkpoints.models.newest}; "
            f"{goodput(self.times.productive, log.seconds_since_start())}"
        )

    def _train_stage(
        self,
        index: int,
        stage: StageConfig,
        batches: DeviceBatches,
        step: int,
        end: int,
        log: MetricsLog,
        stop: StopRequest,
    ) -> tuple[int, bool]:
        """Steps up to `end`, or fewer if the run is to stop; the number of steps done, and whether it is to stop."""
        config = self.config
        # The save of the stage before: who raises may end the others in the middle of it.
        with self.watchdog.other("the save", then_clips=True):
            self.checkpoints.wait()
        self.times.begin()
        raise_together(self._data_failure(batches, end - step), NO_CLIPS)
        while step < end:
            with self.times.waiting():
                batch = next(batches)
            program = self.programs[batch["images"].shape]
            self.profiler.before(step + 1)
            self.state, metrics, finite = program(self.state, batch)
            step += 1
            self.times.count(self._operations_of(batch["images"].shape[:4]))
            self.in_flight.add(step, metrics, finite, batch, batches.names)
            if self.profiler.is_last(step):
                self.in_flight.finish()
                self.profiler.stop()

            due = step % config.save_every == 0 or step == end
            # After a save that is due: clips that are late do not keep it from beginning.
            ending, failure = (None, None) if due else self._reason_to_end(stop, batches, end - step)
            saving = due or ending is not None
            # Intervals begin anew after a save, where a run that is killed goes on.
            if step % config.log_every == 0 or step == 1 or saving or self._failing():
                self.in_flight.finish()
                self._log(step, end, stage, batches.broken_clips, log)
            self.checkpoints.check()
            position = Position(index, batches.get_state())
            if self._failing():
                self._fail(step, position)
            if saving:
                self._save(position)
            if due:
                ending, failure = self._reason_to_end(stop, batches, end - step)
            if ending is not None:
                with self.watchdog.other("the save"):
                    self.checkpoints.wait()
            if self._validation_is_due(step):
                self._validate(step, log)
            if ending is not None:
                log.say(f"stopping after step {step}: {ending}; run the same command to go on")
                with self.watchdog.other("the save"):
                    self.checkpoints.wait()
                raise_together(failure, NO_CLIPS)
                return step, True
        return step, False

    def _non_finite_clips(self, batch: Batch) -> np.ndarray:
        """bool [B]: the clips of a step whose update was left out that by themselves have a non-finite gradient."""
        with self.times.other("search for clips"), self.watchdog.other("the search for clips"):
            return non_finite_clips(self.program.finite_check, self.state.params, batch, self.program.layout)

    def _failing(self) -> bool:
        return self.in_flight.longest_skip >= self.config.max_skipped_in_a_row

    def _fail(self, step: int, position: Position) -> None:
        """Saves, so that the same command goes on past the clips that were named, and raises."""
        longest, row = self.in_flight.longest_skip, int(self.state.skipped_in_a_row)
        zero = jax.device_put(np.int32(0), self.state.step.sharding)
        self.state = self.state._replace(skipped_in_a_row=zero, longest_skip=zero)
        with self.watchdog.other("the save"):  # before, which may still be on its way to the disk
            self.checkpoints.wait()
        # A latest checkpoint with the very same parameters gives place, not the oldest: that may be the good one.
        latest = self.checkpoints.steps[-1]
        self._save(position, in_place_of=latest if step - latest <= row else None)
        self.checkpoints.wait()
        raise NonFiniteTraining(
            f"step {step}: {longest} updates in a row had a non-finite loss or gradient "
            f"(max_skipped_in_a_row={self.config.max_skipped_in_a_row}), with {self.in_flight.blamed}; the same "
            "command goes on past them; if that does not help start a new --workdir with a lower "
            "optimizer.learning_rate, or resume from an earlier checkpoint with --resume_step"
        )

    def _save(self, position: Position, *, in_place_of: int | None = None) -> None:
        with self.times.other("save"), self.watchdog.other("the save"):
            position = position._replace(data=with_all_broken(position.data))
            self.checkpoints.save(self.state, position, in_place_of=in_place_of)

    def _compile(self, stage: StageConfig, sizes: Sequence[tuple[int, int]], log: MetricsLog) -> None:
        """Makes the stage's steps ready for all sizes of its clips, so that none costs a compilation on the way."""
        new = [size for size in sizes if (stage.batch_size, stage.clip_length, *size, 3) not in self.programs]
        if not new:  # an earlier stage had the same
            return
        with self.times.other("compilation"), self.watchdog.other("the compilation", then_clips=True):
            taught = self.config.teacher is not None
            for number, step in enumerate(compiled_steps(self.program, self.state, stage, new, taught=taught), 1):
                self.programs[step.clips] = step.run
                height, width = step.clips[2:4]
                log.say(
                    f"{stage.name}: step for images of {height} x {width} compiled after {step.seconds:.0f} s, "
                    f"{number} of {len(new)}"
                )

    def _operations_of(self, clips: tuple[int, ...]) -> float:
        """Operations of a step on clips [B, T, H, W]; 0 where utilisation is not known.

        Counting them takes seconds for each size: it is done when the first of its steps is on the device, which has
        work meanwhile, so that no start waits for all of them.
        """
        if self.peak is None:
            return 0.0
        if clips not in self.operations:
            self.operations[clips] = step_flops(self.config.model, clips, frozen=frozen_patterns(self.config))
        return self.operations[clips]

    def _log(self, step: int, end: int, stage: StageConfig, broken_clips: int, log: MetricsLog) -> None:
        """One line about the steps since the last one, all of which have finished."""
        speed = self.times.read(stage)
        own = own_facts(speed, broken_clips=broken_clips, memory=most_device_bytes(self.mesh.local_devices))
        values = self.in_flight.means.read()
        report_interval(log, step, values, self.times, speed, from_all(own), config=self.config, stage=stage, end=end)

    def _validation_is_due(self, step: int) -> bool:
        every = None if self.config.validation is None else self.config.validation.every
        return every is not None and (step % every == 0 or step == self.config.total_steps)

    def _validate(self, step: int, log: MetricsLog) -> None:
        if self.validation is None or self.config.validation is None:
            return
        with validation_memory_explained(self.config.validation, self.mesh):
            if not self.validation.compiled:
                # Not a part of what the first of them takes, by which the time left is foretold.
                with self.times.other("compilation of validation"), self.watchdog.other("the compilation"):
                    self.validation.compile(self.state.averaged)
            started = time.perf_counter()
            with self.times.other("validation"), self.watchdog.other("the validation"):
                values, pictures = self.validation(self.state.averaged)
                best = self._keep_if_best(step, values, log)
        log.show(step, pictures)
        log.write(step, values, **{VALIDATION_SET: self.validation_set})
        log.say(
            f"validation after step {step} ({duration(time.perf_counter() - started)}): {validation_line(values)}{best}"
        )

    def _keep_if_best(self, step: int, values: Mapping[str, float], log: MetricsLog) -> str:
        """Keeps the model if none before was better by the metric that the configuration names; says so in words."""
        name = None if self.config.validation is None else self.config.validation.best
        if name is None:
            return ""
        better = False
        # Process 0 has the earlier values and decides.
        if not log.silent and (held := self.checkpoints.best_step) != step:
            earlier = read_metrics(log.path)
            better = is_best(earlier, step, name, values, held=held, digest=self.validation_set)
        if not any_process(better):
            return ""
        self.checkpoints.save_best(self.state)
        return f", the best {name} so far"

    def _data_failure(self, batches: DeviceBatches, left: int) -> BaseException | None:
        """What keeps this process from one of the batches that it needs until all can have stopped; waits for them.

        Those of the `left` steps of the stage, no later ones.
        """
        with self.times.waiting():
            return batches.failure(min(self.vote.notice + 1, left))

    def _reason_to_end(
        self, stop: StopRequest, batches: DeviceBatches, left: int
    ) -> tuple[str | None, BaseException | None]:
        """Why the run ends after this step, in words, None where it does not; what keeps this process from going on."""
        reason, failure = None, None
        if stop.reason is not None:
            reason = f"received {stop.reason}"
        elif self.deadline is not None and time.monotonic() > self.deadline:
            reason = f"max_minutes={self.config.max_minutes} are over"
        elif (failure := self._data_failure(batches, left)) is not None:
            reason = "no more clips can be read"
        # A process that left alone would let the others wait for its share of the next step for ever.
        ending = (reason or "another process is to stop") if self.vote(reason is not None) else None
        return ending, failure


def _peak(mesh: Mesh, dtype: str) -> float | None:
    """Operations a second of all devices at their best; None for CPUs, whose cores share one peak."""
    if mesh.devices.flat[0].platform == "cpu":
        return None
    return mesh.size * matmul_flops_per_second(dtype)
