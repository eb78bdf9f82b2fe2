"""Floating point operations of a program as XLA counts them, every loop times its trips."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend import core


def count_flops(function: Callable[..., Any], *arguments: Any) -> float:
    """Operations of one call, a multiply-add counted as two, on arrays or `jax.ShapeDtypeStruct`, or pytrees of them.

    XLA's cost analysis counts the body of a loop once. Here every `lax.scan` (`lax.map`, `fori_loop` with fixed bounds)
    counts as often as it runs, whatever the depth of nesting. Nothing is compiled and nothing is run. Kernels that XLA
    does not know inside of (cuDNN, Pallas) count nothing: give a model with `attention="xla"`. Raises ValueError for a
    loop whose number of trips is not fixed.
    """
    return _costs(jax.make_jaxpr(function)(*arguments), {})[0]


def _costs(program: core.ClosedJaxpr, known: dict[str, tuple[float, float]]) -> tuple[float, float]:
    """Operations with every loop times its trips, and with every loop's body once, as XLA counts.

    `known` collects the programs that were counted: layers repeat the same loops.
    """
    text = str(program)
    if text not in known:
        arguments = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in program.in_avals]
        analysis = jax.jit(core.jaxpr_as_fun(program)).lower(*arguments).cost_analysis()
        # Programs that only move data have no such entry.
        total = once = float((analysis or {}).get("flops", 0.0))
        for length, body in _outermost_loops(program.jaxpr):
            body_total, body_once = _costs(body, known)
            total += length * body_total - body_once
        known[text] = total, once
    return known[text]


def _outermost_loops(jaxpr: core.Jaxpr) -> Iterator[tuple[int, core.ClosedJaxpr]]:
    """Trips and bodies of the loops that are in no other loop."""
    for equation in jaxpr.eqns:
        name, parameters = equation.primitive.name, equation.params
        if name == "scan":
            yield parameters["length"], parameters["jaxpr"]
        elif name == "while":
            raise ValueError(
                f"count_flops: the number of trips of a loop is not fixed: {equation.source_info.name_stack}"
            )
        else:
            for inner in core.jaxprs_in_params(parameters):
                yield from _outermost_loops(inner)
