"""What a run will need, tried in minutes before it is queued: network, folder, weights, data, and the step."""

from __future__ import annotations

import functools
import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from logvggt_jax.compile import device_bytes
from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.batches import training_batches
from logvggt_jax.errors import InputError, one_line, printable
from logvggt_jax.files import check_writable
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training.checkpoints.checkpoint_files import Position
from logvggt_jax.training.checkpoints.run_checkpoints import RunCheckpoints
from logvggt_jax.training.checkpoints.work_folder import PREFLIGHT
from logvggt_jax.training.config import SourceConfig, StageConfig, TeacherConfig, TrainConfig, ValidationConfig
from logvggt_jax.training.feeding.batches import stage_batches
from logvggt_jax.training.feeding.sources import open_source, open_sources
from logvggt_jax.training.feeding.truth import check_depth, check_truth
from logvggt_jax.training.parallel.agreement import any_process, check_shared
from logvggt_jax.training.parallel.same_settings import check_same_settings
from logvggt_jax.training.parallel.sharding import DATA_AXIS, check_batch_size, parameter_layout, split
from logvggt_jax.training.step.costs import step_costs
from logvggt_jax.training.step.initialization import check_weights
from logvggt_jax.training.step.program import abstract_parameters, make_program
from logvggt_jax.training.teaching.labelling import unlabelled
from logvggt_jax.training.teaching.run_data import label
from logvggt_jax.training.teaching.teacher import PlainVGGT, Teacher
from logvggt_jax.training.validation.validation import Validation, clip_starts

CLIPS = 20
_EXCHANGED_BYTES = 2**26
_GIB = 2**30


def preflight(config: TrainConfig, workdir: Path, mesh: Mesh, say: Callable[[str], None] = print) -> None:
    """Tries what a run does later: an all-reduce, to go on from what the folder holds, or else the sizes of the initial
    weights, clips of every source (of those of a teacher one a process) and of validation, a checkpoint, the steps'
    compilation.

    All processes do it together; process 0 says a line for each. Nothing is left in `workdir`. Raises InputError at
    the end where something failed on a process, and at once where the folder is not shared or the settings differ.
    """
    for stage in config.stages:
        check_batch_size(stage, mesh, accumulate=config.accumulate)
    check_shared(workdir)
    check_same_settings(config)
    failed: list[str] = []

    def attempt(what: str, check: Callable[[], str]) -> None:
        started, problem = time.perf_counter(), None
        try:
            found = check()
        except (InputError, OSError, jax.errors.JaxRuntimeError) as error:
            found = problem = one_line(error)
        # Whatever the others found: they go on to the next together.
        if any_process(problem is not None):
            failed.append(what)
            if problem is not None or jax.process_index() == 0:
                say(f"{what}: FAILED on process {jax.process_index()}: {problem or 'not here; see the other outputs'}")
        elif jax.process_index() == 0:
            say(f"{what}: {found} ({time.perf_counter() - started:.1f} s)")

    attempt("all-reduce", lambda: _all_reduce(mesh))
    resumed: list[int] = []
    attempt("work folder", lambda: _work_folder(config, workdir, resumed))
    weights = config.initial_weights
    if weights is not None:
        attempt("initial weights", lambda: _initial_weights(config, weights, resumed))
    datasets: dict[str, Dataset] = {}

    def find_data() -> str:
        check_truth(config)
        datasets.update(open_sources(config.data, () if config.validation is None else config.validation.sources))
        check_depth(config, datasets)
        return f"{', '.join(datasets)} found" if config.teacher is not None else with_clips()

    def with_clips() -> str:
        for stage in config.stages:
            stage_batches(datasets, config.data, stage, seed=config.seed).close()
        return f"{', '.join(datasets)}, with clips for every stage"

    attempt("data sets", find_data)
    if config.teacher is not None:
        settings, teachers = config.teacher, list[Teacher]()
        attempt("teacher", lambda: _teacher(config, settings, teachers))

        def one_clip_each() -> str:
            # All of a run's clips take hours.
            datasets.update(label(config, settings, teachers[0], datasets, most=jax.process_count())[0])
            return f"{settings.clip_length} frames a clip, one clip a process labelled; {with_clips()}"

        if failed:
            datasets.clear()  # without labels they have no clips
        else:
            attempt("labels", one_clip_each)
        # Their memory is the step's.
        teachers.clear()
        jax.clear_caches()
    for source in config.data.sources:
        if source.name in datasets:
            attempt(source.name, functools.partial(_read_clips, datasets[source.name], source, config))
    validation = config.validation
    if validation is not None:
        attempt("validation", lambda: _validation(config, validation, mesh))
    attempt("checkpoint", lambda: _checkpoint(config, workdir, mesh))
    for stage in config.stages:
        attempt(f"step of {stage.name}", functools.partial(_compile, config, stage, mesh))
    if failed:
        raise InputError(f"preflight: {len(failed)} of the tries failed: {', '.join(failed)}; see the lines above")
    if jax.process_index() == 0:
        say("preflight: all is well")


def _all_reduce(mesh: Mesh) -> str:
    numbers = jax.make_array_from_callback(
        (mesh.size,), split(mesh), lambda index: np.arange(mesh.size, dtype=np.float32)[index]
    )

    def summed(number: jax.Array) -> jax.Array:
        return jax.lax.psum(jnp.broadcast_to(number, (_EXCHANGED_BYTES // 4,)), DATA_AXIS)

    exchange = jax.jit(jax.shard_map(summed, mesh=mesh, in_specs=P(DATA_AXIS), out_specs=P(), check_vma=False))
    exchange(numbers).block_until_ready()
    started = time.perf_counter()
    total = exchange(numbers).block_until_ready()
    seconds = time.perf_counter() - started
    expected = mesh.size * (mesh.size - 1) / 2
    if not bool(jnp.all(total == expected)):
        raise InputError(f"the sum over {mesh.size} devices is {float(total[0])}, expected {expected}")
    return f"{_EXCHANGED_BYTES / 2**20:.0f} MiB over {mesh.size} devices in {seconds * 1e3:.1f} ms"


def _work_folder(config: TrainConfig, workdir: Path, resumed: list[int]) -> str:
    step = RunCheckpoints(workdir, config).resumed_step()
    if step is None:
        return f"a run begins in {workdir}"
    resumed.append(step)
    return f"a run goes on from step {step} in {workdir}"


def _initial_weights(config: TrainConfig, weights: str, resumed: list[int]) -> str:
    if resumed:
        return f"{weights} not needed, the run goes on from its own"
    check_weights(config.model, weights)
    return f"{weights} found, of the model's sizes"


def _teacher(config: TrainConfig, settings: TeacherConfig, teachers: list[Teacher]) -> str:
    assert config.data.cache_dir is not None  # as the configuration checks
    check_writable(Path(config.data.cache_dir).absolute() / "teacher")
    teacher = PlainVGGT(settings)
    teacher.load()  # also where the clips that are tried have labels already
    teachers.append(teacher)
    return f"{settings.weights}, labels go to {config.data.cache_dir}"


def _read_clips(dataset: Dataset, source: SourceConfig, config: TrainConfig) -> str:
    stage, count = config.stages[0], jax.process_count()
    with training_batches(
        {source.name: dataset},
        clip_length=stage.clip_length,
        batch_size=count,
        sizes=stage.sizes,
        seed=config.seed,
        stride=source.stride or (stage.min_stride, stage.max_stride),
        reverse=config.data.reverse,
        augmentation=config.data.augmentation,
        min_valid_depth=config.data.min_valid_depth,
        max_broken=0.99,  # All are read, and then judged.
        process_index=jax.process_index(),
        process_count=count,
        num_threads=config.data.num_threads,
    ) as batches:
        started = time.perf_counter()
        for _ in range(CLIPS):
            next(batches)
        rate, broken = CLIPS / (time.perf_counter() - started), batches.broken
    if broken.count > math.ceil(config.data.max_broken * CLIPS):
        raise InputError(f"{broken.count} of {CLIPS} clips are broken: {printable('; '.join(broken.messages))}")
    return f"{CLIPS} clips of {stage.clip_length} frames, {rate:.1f} a second in one process, {broken.count} broken"


def _validation(config: TrainConfig, settings: ValidationConfig, mesh: Mesh) -> str:
    count = settings.num_clips * len(settings.sources)
    clips = f"{count} clips of {settings.clip_length} frames at {settings.size[0]}x{settings.size[1]}"
    if config.teacher is not None and config.teacher.validation:
        # To label them takes hours; how long they are is known before.
        for source in settings.sources:
            clip_starts(source.name, unlabelled(open_source(source), config.teacher), settings)
        return f"{clips}, to be labelled"
    layout = parameter_layout(abstract_parameters(config.model), mesh, shard=config.shard_parameters)
    Validation(LogVGGT(config.model), settings, layout)
    return f"{clips}, read"


def _checkpoint(config: TrainConfig, workdir: Path, mesh: Mesh) -> str:
    shapes = abstract_parameters(config.model)
    program = make_program(LogVGGT(config.model), config, shapes, mesh)
    state = program.initial_state(jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes))
    folder = workdir / PREFLIGHT
    with RunCheckpoints(folder, config) as checkpoints:
        # Within its lock: the folder of another preflight is not this one's to delete.
        try:
            started = time.perf_counter()
            checkpoints.save(state, Position(0, {}))
            checkpoints.wait()
            seconds = time.perf_counter() - started
            size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        finally:
            any_process(False)  # The others may still look at it.
            if jax.process_index() == 0:
                shutil.rmtree(folder, ignore_errors=True)
    return f"{size / _GIB:.2f} GiB with the model written to {folder} in {seconds:.1f} s, and deleted"


def _compile(config: TrainConfig, stage: StageConfig, mesh: Mesh) -> str:
    size, clips = max(stage.sizes, key=math.prod), stage.batch_size // mesh.size
    name = f"{clips} clips a device of {stage.clip_length} frames at {size[0]}x{size[1]}"
    costs = step_costs(config, mesh, clips, stage.clip_length, size)
    limit = device_bytes(mesh.devices.flat[0])
    if costs is None or not costs.fits(limit):
        raise InputError(f"{name} do not fit the memory of a device; --dry_run says what does")
    needed = f"{costs.memory / _GIB:.2f} GiB"
    return f"{name}, {needed}{'' if limit is None else f' of {limit / _GIB:.1f} GiB'}, compiled"
