"""What a run's steps need, said before anything is trained: for each stage and size, and how many clips would fit."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
from jax.sharding import AxisType, Mesh

from logvggt_jax.compile import device_bytes
from logvggt_jax.described import attention_kernels, described_bytes, described_devices
from logvggt_jax.training.config import StageConfig, TrainConfig
from logvggt_jax.training.parallel.sharding import DATA_AXIS, check_batch_size
from logvggt_jax.training.step.costs import StepCosts, step_costs, step_flops
from logvggt_jax.training.step.freezing import frozen_patterns

_GIB = 2**30
# Numbers of clips that a device takes at once, tried for the largest that fits: each is a compilation of minutes.
_TRIED_CLIPS = (1, 2, 4, 8)


def dry_run(config: TrainConfig, mesh: Mesh, say: Callable[[str], None] = print) -> None:
    """Says for every stage and size what a step needs on `mesh`, and how many clips a device fit at the largest size.

    The devices may be described ones. Raises InputError where a stage's batches do not split over them.
    """
    for stage in config.stages:
        check_batch_size(stage, mesh, accumulate=config.accumulate)
    with attention_kernels(mesh.devices.flat[0]) as attention:
        if config.model.attention == "auto":
            # Chosen by the device at hand, which a described one is not.
            config = dataclasses.replace(config, model=dataclasses.replace(config.model, attention=attention))
        _say_all(config, mesh, say)


def _say_all(config: TrainConfig, mesh: Mesh, say: Callable[[str], None]) -> None:
    limit = device_bytes(mesh.devices.flat[0]) or described_bytes(mesh.devices.flat[0])
    memory = "memory not known" if limit is None else f"{limit / _GIB:.1f} GiB each"
    say(f"{mesh.size} x {mesh.devices.flat[0].device_kind}, {memory}; nothing is allocated or run")

    # A compilation of minutes is made once for each shape, whoever asks for it.
    @functools.cache
    def costs_of(clips: int, clip_length: int, size: tuple[int, int]) -> StepCosts | None:
        return step_costs(config, mesh, clips, clip_length, size)

    for stage in config.stages:
        for size in stage.sizes:
            clips = stage.batch_size // mesh.size
            name = f"{stage.name} {size[0]}x{size[1]}, {clips} x {stage.clip_length} frames a device"
            operations = step_flops(
                config.model, (stage.batch_size, stage.clip_length, *size), frozen=frozen_patterns(config)
            )
            costs = costs_of(clips, stage.clip_length, size)
            say(f"{name}: {operations / 1e12:.4g} TFLOP in all without recomputation; {_described(costs, limit)}")
        say(f"{stage.name}: {_largest_that_fits(costs_of, mesh, stage, limit, config.accumulate)}")


def described_mesh(name: str) -> Mesh:
    """A mesh over devices that are described alone, see `described_devices`."""
    return Mesh(np.array(described_devices(name)), (DATA_AXIS,), axis_types=(AxisType.Auto,))


def _largest_that_fits(
    costs_of: Callable[[int, int, tuple[int, int]], StepCosts | None],
    mesh: Mesh,
    stage: StageConfig,
    limit: int | None,
    accumulate: int,
) -> str:
    if limit is None and mesh.devices.flat[0].platform != "tpu":  # a described TPU's compiler knows
        return "how many clips fit is not known, these devices do not say how much memory they have"
    size, fitting = max(stage.sizes, key=math.prod), 0
    numbers = [accumulate * clips for clips in _TRIED_CLIPS]
    for clips in numbers:
        costs = costs_of(clips, stage.clip_length, size)
        if costs is None or not costs.fits(limit):
            break
        fitting = clips
    tried = f"of {', '.join(map(str, numbers))} clips a device at {size[0]}x{size[1]}"
    if not fitting:
        return f"none {tried} fits: fewer frames (clip_length) or smaller images (sizes) do"
    return f"{fitting} is the largest {tried} that fits, batch_size={fitting * mesh.size}"


def _described(costs: StepCosts | None, limit: int | None) -> str:
    if costs is None:
        return "does not fit the memory, says the compiler"
    exchanged = ", ".join(
        f"{count} {name} of {size / _GIB:.3g} GiB" for name, (count, size) in sorted(costs.collectives.items())
    )
    return (
        f"arguments {costs.arguments / _GIB:.3g} GiB, temporaries {costs.temporaries / _GIB:.3g} GiB"
        f"{'' if costs.fits(limit) else ', which do not fit'}; {exchanged or 'no collectives'}; "
        f"compiled in {costs.compilation:.0f} s"
    )
