"""Parameters that are read without a trace of how they began."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import numpy as np
from flax.errors import ScopeParamShapeError


class ShapeCheck:
    """Makes a linen module that compares a given parameter's shape with the one asked for, and no more.

    Linen itself traces the initial value of every parameter that is read, only to know that shape: nearly half of the
    time in which this model is traced, and it is traced for every program. For initialisers that are called with the
    shape first; parameters that are not given begin as linen begins them, and at once, whatever else is only traced.
    Comes before the module among the bases.

    Raises:
      flax.errors.ScopeParamShapeError: a given parameter has another shape.
    """

    def param(self, name: str, init_fn: Any, *init_args: Any, unbox: bool = True, **init_kwargs: Any) -> Any:
        module: Any = self
        if not module.has_variable("params", name):
            with jax.ensure_compile_time_eval():
                return super().param(name, init_fn, *init_args, unbox=unbox, **init_kwargs)  # type: ignore[misc]
        value, shape = module.get_variable("params", name), init_args[0]
        if np.shape(value) != tuple(shape):
            raise ScopeParamShapeError(name, module.scope.path_text, np.shape(value), shape)
        return value


class Dense(ShapeCheck, nn.Dense):
    """`nn.Dense` that checks shapes alone."""


class LayerNorm(ShapeCheck, nn.LayerNorm):
    """`nn.LayerNorm` that checks shapes alone."""
