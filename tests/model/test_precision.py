"""Float32 parts of the network stay float32 on devices whose default is to round products."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from logvggt_jax import LogVGGT

WHOLE = jax.lax.Precision.HIGHEST


def products(jaxpr: Any) -> Iterator[Any]:
    """Matrix products and convolutions of a program, those inside its loops included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("dot_general", "conv_general_dilated"):
            yield equation
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            if hasattr(inner, "jaxpr"):
                inner = inner.jaxpr
            if hasattr(inner, "eqns"):
                yield from products(inner)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("backend", ["cpu", "tpu"])
def test_float32_products_ask_for_full_precision(small_config, small_variables, monkeypatch, dtype, backend):
    # Convolutions take another form on CPUs; attention must not pick a kernel of a device that is not there.
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    model = LogVGGT(dataclasses.replace(small_config, dtype=dtype, attention="xla"))
    images = jnp.zeros((1, 6, 28, 42, 3))
    program = jax.make_jaxpr(model.apply)(small_variables, images)
    rounded, whole = 0, 0
    for equation in products(program.jaxpr):
        operands = {variable.aval.dtype for variable in equation.invars}
        if jnp.dtype("float32") in operands:
            assert equation.params["precision"] == (WHOLE, WHOLE), equation
            whole += 1
        else:
            rounded += 1
    # The camera head is float32 in either case; encoder, blocks and depth head follow the compute type.
    assert whole > 5
    assert (rounded > 20) == (dtype == "bfloat16")
