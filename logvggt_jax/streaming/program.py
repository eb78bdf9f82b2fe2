"""Programs of a method before it has parameters or frames: for estimates of what it needs, and to compile them."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.operations import count_flops
from logvggt_jax.weights.vggt import parameter_shapes


class Program(NamedTuple):
    """One call of a method's program.

    Attributes:
      lowered: the program, which compiles into what a stream runs.
      flops: operations of a call.
      frames: that become final with a call.
    """

    lowered: jax.stages.Lowered
    flops: float
    frames: int


def abstract_variables(config: ModelConfig) -> dict[str, Any]:
    """Shapes of {"params": …} as a stream holds them: in the compute type."""
    return jax.eval_shape(lambda x: in_compute_type(x, config), {"params": parameter_shapes(config)})


def flops_of(model: LogVGGT, call: Callable[[LogVGGT], Callable[..., Any]], *arguments: Any) -> float:
    """Operations of `call(model)` on abstract arguments, whichever kernels the model has."""
    return count_flops(call(LogVGGT(dataclasses.replace(model.config, attention="xla"))), *arguments)


@contextlib.contextmanager
def compiled_meanwhile(lower: Callable[[], Sequence[jax.stages.Lowered]]) -> Iterator[None]:
    """Compiles what `lower` gives, all at once, in threads of their own while the body runs, whose end waits for them.

    Calls of the same programs then find them made. What fails here fails in these calls as well, where it is explained;
    what the body raises waits for nothing.
    """
    pool = ThreadPoolExecutor(thread_name_prefix="compilation")
    begun = pool.submit(lambda: [pool.submit(lowered.compile) for lowered in lower()])
    try:
        yield
        wait([begun])
        if begun.exception() is None:
            wait(begun.result())
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
