"""Convolutions: values and hand-written gradients equal the compiler's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.model.convolution import Convolution
from logvggt_jax.operations import count_flops


def reference(x, kernel, bias, strides):
    margin = (kernel.shape[0] - 1) // 2
    y = jax.lax.conv_general_dilated(
        x,
        kernel,
        (strides, strides),
        ((margin, margin), (margin, margin)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return y + bias


@pytest.mark.parametrize(("size", "strides"), [(1, 1), (3, 1), (3, 2), (5, 1)])
@pytest.mark.parametrize(("height", "width"), [(4, 5), (1, 1)])
def test_values_and_gradients(size, strides, height, width):
    generator = np.random.default_rng(0)
    x = generator.standard_normal((2, height, width, 3)).astype(np.float32)
    layer = Convolution(6, size, "float32", strides=strides)
    params = jax.device_get(layer.init(jax.random.key(0), x)["params"])
    params["bias"] = generator.standard_normal(6).astype(np.float32)
    shape = jax.eval_shape(layer.apply, {"params": params}, x).shape
    weights = generator.standard_normal(shape).astype(np.float32)

    def ours(params, x):
        return layer.apply({"params": params}, x)

    def theirs(params, x):
        return reference(x, params["kernel"], params["bias"], strides)

    def value_and_gradients(function):
        def weighted(params, x):
            value = function(params, x)
            return (value * weights).sum(), value

        gradients, value = jax.jit(jax.grad(weighted, argnums=(0, 1), has_aux=True))(params, x)
        return value, gradients

    value, gradients = value_and_gradients(ours)
    expected, others = value_and_gradients(theirs)
    np.testing.assert_allclose(value, expected, atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), gradients, others)


@pytest.mark.parametrize(("platform", "convolutions", "products"), [("cpu", 2, 1), ("cuda", 3, 0), ("tpu", 3, 0)])
def test_gradients_have_the_form_of_the_platform_that_they_are_lowered_for(platform, convolutions, products):
    """Whatever this machine has: programs for described accelerators are compiled on CPUs."""
    layer = Convolution(6, 3, "float32")
    x = jax.ShapeDtypeStruct((1, 4, 5, 3), jnp.float32)
    variables = jax.eval_shape(layer.init, jax.eval_shape(jax.random.key, 0), x)
    gradients = jax.jit(jax.grad(lambda variables, x: (layer.apply(variables, x) ** 2).sum(), argnums=(0, 1)))
    program = gradients.trace(variables, x).lower(lowering_platforms=(platform,)).as_text()
    assert (program.count("stablehlo.convolution"), program.count("stablehlo.dot_general")) == (convolutions, products)
    assert count_flops(gradients, variables, x) == 3 * count_flops(layer.apply, variables, x)


def test_bfloat16_computes_in_bfloat16():
    x = np.ones((1, 4, 4, 3), np.float32)
    layer = Convolution(6, 3, "bfloat16")
    assert layer.apply(layer.init(jax.random.key(0), x), x).dtype == jnp.bfloat16
