"""Floating point operations of a program, counted from its own shapes, and how many a device does in a second."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core

# In the names of what `jax.checkpoint` does again for a gradient.
_RECOMPUTED = "rematted_computation"


def count_flops(function: Callable[..., Any], *arguments: Any, recomputed: bool = True) -> float:
    """Operations of one call in matrix products and convolutions, a multiply-add counted as two.

    All else of a network (norms, activations, softmax) is a few parts in a thousand and limited by memory, not by
    operations; utilisation is stated without it. A loop counts as often as it runs, whatever the depth of nesting, a
    condition as its dearest branch, the body of a `shard_map` once for every device. Nothing is compiled and nothing is
    run.

    Args:
      function: what `jax.jit` takes. Kernels (cuDNN, Pallas) count nothing: give a model with `attention="xla"`.
      *arguments: arrays or `jax.ShapeDtypeStruct`, or pytrees of them.
      recomputed: whether what a gradient computes a second time (`jax.checkpoint`) counts twice.

    Raises:
      ValueError: a loop whose number of trips is not fixed.
    """
    return _flops(jax.make_jaxpr(function)(*arguments).jaxpr, recomputed)


def matmul_flops_per_second(dtype: str, *, size: int | None = None, rounds: int = 5) -> float:
    """The fastest of `rounds` large products of square matrices of `dtype`: a peak that programs can be held against.

    `size` is their side; None takes 1536 on CPUs and 8192 elsewhere. The values are random: a GPU draws less power on
    equal ones, and would be faster than any program of use.
    """
    side = size or (1536 if jax.default_backend() == "cpu" else 8192)
    factor = jax.random.normal(jax.random.key(0), (side, side), dtype)
    product = jax.jit(lambda x: x @ x)
    jax.block_until_ready(product(factor))
    seconds = []
    for _ in range(rounds):
        started = time.perf_counter()
        jax.block_until_ready(product(factor))
        seconds.append(time.perf_counter() - started)
    return 2 * side**3 / min(seconds)


def _flops(jaxpr: core.Jaxpr, recomputed: bool) -> float:
    total = 0.0
    for equation in jaxpr.eqns:
        if not recomputed and _RECOMPUTED in str(equation.source_info.name_stack):
            continue
        name, parameters = equation.primitive.name, equation.params
        if name == "dot_general":
            total += _product_flops(equation)
        elif name == "conv_general_dilated":
            total += _convolution_flops(equation)
        elif name == "scan":
            total += parameters["length"] * _flops(parameters["jaxpr"].jaxpr, recomputed)
        elif name == "cond":
            total += max(_flops(branch.jaxpr, recomputed) for branch in parameters["branches"])
        elif name == "shard_map":
            total += parameters["mesh"].size * _flops(parameters["jaxpr"], recomputed)
        elif name == "while":
            raise ValueError(
                f"count_flops: the number of trips of a loop is not fixed: {equation.source_info.name_stack}"
            )
        elif name != "pallas_call":  # whose program is that of one block
            # jit, checkpoint and rules of differentiation: what they hold runs once.
            total += sum(_flops(inner, recomputed) for inner in core.jaxprs_in_params(parameters))
    return total


def _product_flops(equation: Any) -> float:
    (contracted, _), _ = equation.params["dimension_numbers"]
    left = equation.invars[0].aval.shape
    return 2.0 * math.prod(equation.outvars[0].aval.shape) * math.prod(left[axis] for axis in contracted)


def _convolution_flops(equation: Any) -> float:
    kernel = equation.invars[1].aval.shape
    features = kernel[equation.params["dimension_numbers"].rhs_spec[0]]
    # A value of the output sums over all of the kernel but its output features. Of a dilated input most values are
    # zeros between the others, with which nothing has to be multiplied.
    products = math.prod(kernel) / features / math.prod(equation.params["lhs_dilation"])
    return 2.0 * math.prod(equation.outvars[0].aval.shape) * products
