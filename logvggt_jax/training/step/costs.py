"""What a training step costs, counted or by the compiler's account: nothing is allocated or run."""

from __future__ import annotations

import dataclasses
import re
import time
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from logvggt_jax.compile import out_of_device_memory
from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import unstack_layers
from logvggt_jax.operations import count_flops
from logvggt_jax.program_text import ProgramText, bytes_of
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import split
from logvggt_jax.training.step.freezing import frozen_leaves
from logvggt_jax.training.step.program import abstract_parameters, make_program

# What is exchanged in the background is counted where it ends, with the result's own shape.
_COLLECTIVE = re.compile(
    r" = (.*?) (all-reduce|all-gather|reduce-scatter|all-to-all|collective-permute|ragged-all-to-all)(?:-done)?\("
)


@dataclasses.dataclass(frozen=True)
class StepCosts:
    """What a compiled step needs on each device, by the compiler's own account.

    Attributes:
      arguments: bytes of parameters, moments and the batch; the new state takes the old one's place.
      temporaries: bytes at the most.
      collectives: exchanges between devices in a step, by name: how many and the bytes of their results.
      compilation: seconds.
    """

    arguments: int
    temporaries: int
    collectives: dict[str, tuple[int, int]]
    compilation: float

    @property
    def memory(self) -> int:
        """Bytes that a device holds at the most."""
        return self.arguments + self.temporaries

    def fits(self, limit: int | None) -> bool:
        """Whether a device of `limit` bytes can take the step; True where that is not known (None)."""
        return limit is None or self.memory <= limit


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


def step_flops(config: ModelConfig, clips: tuple[int, ...], *, frozen: tuple[str, ...]) -> float:
    """Operations of a step on clips [B, T, H, W] over all devices: the predictions and their gradient with respect to
    what is not `frozen` (see `freezing`), nothing computed twice."""
    model = LogVGGT(dataclasses.replace(config, attention="xla"))
    # Layer by layer: in a loop a layer that reads the cache would stand for all.
    still = unstack_layers(frozen_leaves(abstract_parameters(config), frozen), config, lambda leaf, _: leaf)

    def gradient(params: Any, images: jax.Array) -> Any:
        def predictions(params: Any) -> Any:
            stopped = jax.tree.map(lambda x, still: jax.lax.stop_gradient(x) if still else x, params, still)
            return model.apply({"params": stopped}, images)

        found, pull_back = jax.vjp(predictions, params)
        return pull_back(jax.tree.map(jnp.ones_like, found))

    images = jax.ShapeDtypeStruct((*clips, 3), jnp.uint8)
    return count_flops(gradient, variable_shapes(config)["params"], images, recomputed=False)


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
        compiled = program.step.lower(program.abstract_state, batch).compile()
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


def collectives(program: str) -> dict[str, tuple[int, int]]:
    """Number and bytes of the exchanges between devices in a run of a compiled program, from its text, by name.

    One in a loop counts as often as the loop runs, see `ProgramText.runs`: the training step exchanges its sums outside
    of all loops, while parameters in parts are put together within them.
    """
    found: dict[str, tuple[int, int]] = {}
    text = ProgramText(program)
    for computation, times in text.runs().items():
        for line in text.lines[computation]:
            if match := _COLLECTIVE.search(line):
                count, total = found.get(match[2], (0, 0))
                found[match[2]] = count + times, total + times * bytes_of(match[1])
    return found
