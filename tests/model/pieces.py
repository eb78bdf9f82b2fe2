"""A computation as few small programs: its blocks, each compiled once for all layers, and what lies between them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from logvggt_jax.model import frame_by_frame, parameters, windows
from logvggt_jax.model.aggregator import Aggregator
from logvggt_jax.model.dinov2 import DinoV2


def in_pieces(function: Callable[..., Any], static: int = 0) -> Callable[..., Any]:
    """`function` of arrays, after the first `static` arguments, without the cost of compiling it whole.

    As one program a block would be compiled in the place of every layer; operation by operation, what lies between
    blocks would be a hundred programs. Here each module that `parameters.run` calls is a program, the same one for all
    layers, and so is all that comes between two of them. Encoder and aggregator are taken apart into their blocks.
    """
    jitted = jax.jit(function, static_argnums=tuple(range(static)))

    def run(module: Any, params: Any, *inputs: Any, **options: Any) -> Any:
        if isinstance(module, Aggregator | DinoV2):
            return module.apply({"params": params}, *inputs, **options)
        return parameters.run(module, params, *inputs, **options)

    @functools.wraps(function)
    def in_turn(*arguments: Any) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            for module in (windows, frame_by_frame):
                patch.setattr(module, "run", run)
            traced = jitted.trace(*arguments)
        found = _evaluated(traced.jaxpr, jax.tree.leaves(arguments[static:]))
        return jax.tree.unflatten(jax.tree.structure(traced.out_info), found)

    return in_turn


def _evaluated(closed: ClosedJaxpr, arguments: Sequence[Any]) -> list[Any]:
    values = dict(zip([*closed.jaxpr.constvars, *closed.jaxpr.invars], [*closed.consts, *arguments], strict=True))

    def value(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for program, inputs, outputs in _programs(closed.jaxpr):
        values.update(zip(outputs, program(*map(value, inputs)), strict=True))
    return [value(atom) for atom in closed.jaxpr.outvars]


@functools.lru_cache(maxsize=64)
def _programs(jaxpr: Jaxpr) -> list[tuple[Any, list[Any], list[Any]]]:
    """The programs of a computation in turn, with the variables that each reads and makes."""
    found, wanted = [], {atom for atom in jaxpr.outvars if not isinstance(atom, Literal)}
    for piece in reversed(list(_pieces(jaxpr.eqns))):
        if _is_call(piece[0]):
            found.append((_compiled_once(piece[0].params["jaxpr"]), piece[0].invars, piece[0].outvars))
        else:
            made = [each for equation in piece for each in equation.outvars]
            read = dict.fromkeys(x for equation in piece for x in equation.invars if not isinstance(x, Literal))
            inputs, outputs = [x for x in read if x not in set(made)], [x for x in made if x in wanted]
            effects = frozenset().union(*(equation.effects for equation in piece))
            between = jaxpr.replace(constvars=[], invars=inputs, outvars=outputs, eqns=piece, effects=effects)
            found.append((_compiled_once_by_text(ClosedJaxpr(between, []), str(between)), inputs, outputs))
        wanted |= {atom for atom in found[-1][1] if not isinstance(atom, Literal)}
    return found[::-1]


def _pieces(equations: Sequence[JaxprEqn]) -> Iterator[list[JaxprEqn]]:
    piece: list[JaxprEqn] = []
    for equation in equations:
        if _is_call(equation):
            if piece:
                yield piece
            yield [equation]
            piece = []
        else:
            piece.append(equation)
    if piece:
        yield piece


def _is_call(equation: JaxprEqn) -> bool:
    return equation.params.get("name") == "run" and "jaxpr" in equation.params


@functools.lru_cache(maxsize=256)
def _compiled_once(closed: ClosedJaxpr) -> Callable[..., Any]:
    return jax.jit(jaxpr_as_fun(closed))


_by_text: dict[str, Callable[..., Any]] = {}


def _compiled_once_by_text(closed: ClosedJaxpr, text: str) -> Callable[..., Any]:
    """What lies between two blocks is traced anew for every layer, and reads the same."""
    compiled = jax.jit(jaxpr_as_fun(closed))
    return _by_text.setdefault(text, compiled) if _is_told_by_its_text(closed) else compiled


def _is_told_by_its_text(closed: ClosedJaxpr) -> bool:
    """Constants of functions within it and callbacks are not in it."""
    values = [value for equation in closed.jaxpr.eqns for value in equation.params.values()]
    inner = [each for value in values for each in (value if isinstance(value, tuple) else (value,))]
    callbacks = any("callback" in equation.primitive.name for equation in closed.jaxpr.eqns)
    nested = (each for each in inner if isinstance(each, ClosedJaxpr))
    return not closed.consts and not callbacks and all(map(_is_told_by_its_text, nested))
