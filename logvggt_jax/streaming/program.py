"""The program in which a method spends its time, for estimates of what it needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
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
