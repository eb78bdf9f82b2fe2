"""What a run's training step costs before anything is trained: compiled for abstract values, nothing is allocated."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import math
import os
import re
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh

from logvggt_jax.compile import device_bytes, out_of_device_memory
from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import InputError, MissingPackage, one_line
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.operations import count_flops
from logvggt_jax.training.config import StageConfig, TrainConfig
from logvggt_jax.training.parallel.sharding import DATA_AXIS, check_batch_size, split
from logvggt_jax.training.step.program import abstract_parameters, make_program

_GIB = 2**30
# Numbers of clips that a device takes at once, tried for the largest that fits: each is a compilation of minutes.
_TRIED_CLIPS = (1, 2, 4, 8)
_COLLECTIVE = re.compile(
    r"= (.*?) (all-reduce|all-gather|reduce-scatter|all-to-all|collective-permute)(?:-start)?\(", re.MULTILINE
)
_ARRAY = re.compile(r"([a-z]+)(\d*)[a-z0-9]*\[([\d,]*)\]")


@dataclasses.dataclass(frozen=True)
class StepCosts:
    """What a compiled step needs on each device, by the compiler's own account.

    Attributes:
      arguments: bytes of parameters, moments and the batch; the new state takes the old one's place.
      temporaries: bytes at the most.
      collectives: exchanges between devices, by name: how many and the bytes of their results.
      compilation: seconds.
    """

    arguments: int
    temporaries: int
    collectives: dict[str, tuple[int, int]]
    compilation: float


def dry_run(config: TrainConfig, mesh: Mesh, say: Callable[[str], None] = print) -> None:
    """Says for every stage and size what a step needs on `mesh`, and how many clips a device fit at the largest size.

    The devices may be described ones. Raises InputError where a stage's batches do not split over them.
    """
    for stage in config.stages:
        check_batch_size(stage, mesh, accumulate=config.accumulate)
    if mesh.devices.flat[0].platform == "tpu" and config.model.attention == "auto":
        # Chosen by the device at hand, which a described one is not.
        config = dataclasses.replace(config, model=dataclasses.replace(config.model, attention="tpu_flash"))
    limit = device_bytes(mesh.devices.flat[0])
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
            operations = step_flops(config.model, (stage.batch_size, stage.clip_length, *size))
            costs = costs_of(clips, stage.clip_length, size)
            say(f"{name}: {operations / 1e12:.4g} TFLOP in all without recomputation; {_described(costs, limit)}")
        say(f"{stage.name}: {_largest_that_fits(costs_of, mesh, stage, limit, config.accumulate)}")


def described_mesh(topology: str) -> Mesh:
    """A mesh over a TPU slice that is described alone, such as "v5p:2x2x4"; needs the `libtpu` wheel and no TPU.

    Raises InputError for a topology that libtpu does not know, MissingPackage without libtpu.
    """
    if importlib.util.find_spec("libtpu") is None:
        raise MissingPackage("--described compiles with the libtpu package: pip install libtpu")
    # Otherwise it asks the network which TPU this machine has.
    os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")
    from jax.experimental import topologies

    try:
        devices = topologies.get_topology_desc(topology_name=topology, platform="tpu").devices
    except Exception as error:  # of whatever kind the library raises
        raise InputError(
            f"--described={topology}: no such TPU slice, expected one like v5p:2x2x4 ({one_line(error):.200})"
        ) from error
    return Mesh(np.array(devices), (DATA_AXIS,), axis_types=(AxisType.Auto,))


def step_flops(config: ModelConfig, clips: tuple[int, ...]) -> float:
    """Operations of a step on clips [B, T, H, W] over all devices: forward and gradient, nothing computed twice."""
    model = LogVGGT(dataclasses.replace(config, attention="xla"))
    params, images = abstract_parameters(config), jax.ShapeDtypeStruct((*clips, 3), jnp.uint8)
    forward = count_flops(lambda p, x: model.apply({"params": p}, x), params, images)
    encoder = count_flops(lambda p, x: model.windows.encode({"params": p}, x), params, images)
    # The gradient of a product is two of the kind; a frozen encoder has none.
    return 3 * forward - 2 * encoder if config.encoder.frozen else 3 * forward


def step_costs(
    config: TrainConfig, mesh: Mesh, clips: int, clip_length: int, size: tuple[int, int]
) -> StepCosts | None:
    """Compiles the step for `clips` a device; None where the compiler finds that they do not fit."""
    params = abstract_parameters(config.model)
    program = make_program(LogVGGT(config.model), config, params, mesh)
    batch = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=split(mesh)),
        abstract_clips(clips * mesh.size, clip_length, size, taught=config.teacher is not None),
    )
    started = time.perf_counter()
    try:
        compiled = program.step.lower(program.abstract_state(params), batch).compile()
    except jax.errors.JaxRuntimeError as error:
        if out_of_device_memory(error):
            return None
        raise
    memory: Any = compiled.memory_analysis()
    return StepCosts(
        arguments=memory.argument_size_in_bytes,
        temporaries=memory.temp_size_in_bytes,
        collectives=collectives(compiled.as_text() or ""),
        compilation=time.perf_counter() - started,
    )


def abstract_clips(
    batch: int, frames: int, size: tuple[int, int], *, taught: bool = False
) -> dict[str, jax.ShapeDtypeStruct]:
    """A batch as the training step takes it, without values; with a teacher's confidence where it is `taught`."""
    confidence = {"confidence": jax.ShapeDtypeStruct((batch, frames, *size), jnp.float32)} if taught else {}
    return {
        **confidence,
        "images": jax.ShapeDtypeStruct((batch, frames, *size, 3), jnp.uint8),
        "depth": jax.ShapeDtypeStruct((batch, frames, *size), jnp.float32),
        "intrinsics": jax.ShapeDtypeStruct((batch, frames, 3, 3), jnp.float32),
        "extrinsics": jax.ShapeDtypeStruct((batch, frames, 4, 4), jnp.float32),
    }


def collectives(program: str) -> dict[str, tuple[int, int]]:
    """Number and bytes of the exchanges between devices in a compiled program's text, by name.

    One in a loop counts once. The training step exchanges its sums outside of all loops; parameters in parts are put
    together within them.
    """
    found: dict[str, tuple[int, int]] = {}
    for shapes, name in _COLLECTIVE.findall(program):
        size = 0
        for kind, bits, shape in _ARRAY.findall(shapes):
            items = math.prod(int(side) for side in shape.split(",") if side)
            size += items * (1 if kind == "pred" else int(bits) // 8)
        count, total = found.get(name, (0, 0))
        found[name] = count + 1, total + size
    return found


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
        if costs is None or not _fits(costs, limit):
            break
        fitting = clips
    tried = f"of {', '.join(map(str, numbers))} clips a device at {size[0]}x{size[1]}"
    if not fitting:
        return f"none {tried} fits: fewer frames (clip_length) or smaller images (sizes) do"
    return f"{fitting} is the largest {tried} that fits, batch_size={fitting * mesh.size}"


def _fits(costs: StepCosts, limit: int | None) -> bool:
    return limit is None or costs.arguments + costs.temporaries <= limit


def _described(costs: StepCosts | None, limit: int | None) -> str:
    if costs is None:
        return "does not fit the memory, says the compiler"
    exchanged = ", ".join(
        f"{count} {name} of {size / _GIB:.3g} GiB" for name, (count, size) in sorted(costs.collectives.items())
    )
    return (
        f"arguments {costs.arguments / _GIB:.3g} GiB, temporaries {costs.temporaries / _GIB:.3g} GiB"
        f"{'' if _fits(costs, limit) else ', which do not fit'}; {exchanged or 'no collectives'}; "
        f"compiled in {costs.compilation:.0f} s"
    )
