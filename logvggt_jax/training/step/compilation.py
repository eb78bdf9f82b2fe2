"""A stage's steps compiled before its first one, several at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import NamedTuple

import jax

from logvggt_jax.training.config import StageConfig
from logvggt_jax.training.parallel.sharding import split
from logvggt_jax.training.step.costs import abstract_clips
from logvggt_jax.training.step.program import Program
from logvggt_jax.training.step.state import TrainState

# Each compilation of a billion parameters takes several GB of the host.
_AT_ONCE = 4


class CompiledStep(NamedTuple):
    """The step for clips of one size.

    Attributes:
      clips: shape of a batch's images, (B, T, H, W, 3).
      run: takes a state and a batch.
      seconds: from the start of the first of its stage until it was ready.
    """

    clips: tuple[int, ...]
    run: jax.stages.Compiled
    seconds: float


def compiled_steps(
    program: Program,
    state: TrainState,
    stage: StageConfig,
    sizes: Sequence[tuple[int, int]],
    *,
    taught: bool = False,
) -> Iterator[CompiledStep]:
    """The stage's step for every one of `sizes`, in the order in which they are ready.

    Clips that are `taught` have a teacher's confidence. The steps are compiled in threads, as many at a time as there
    are cores, four at most; JAX keeps them on the disk where its cache is on. Nothing is allocated: `state` gives
    shapes and places alone.
    """
    sharding = split(program.layout.mesh)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), state)
    started = time.perf_counter()

    def compiled(size: tuple[int, int]) -> CompiledStep:
        clips = abstract_clips(stage.batch_size, stage.clip_length, size, taught=taught)
        placed = {name: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding) for name, x in clips.items()}
        run = program.step.lower(shapes, placed).compile()
        return CompiledStep(clips["images"].shape, run, time.perf_counter() - started)

    with ThreadPoolExecutor(min(len(sizes), os.cpu_count() or 1, _AT_ONCE), "compilation") as threads:
        pending = [threads.submit(compiled, size) for size in sizes]
        try:
            for each in as_completed(pending):
                yield each.result()
        finally:
            # One that failed ends the stage: the others need not begin.
            for future in pending:
                future.cancel()
