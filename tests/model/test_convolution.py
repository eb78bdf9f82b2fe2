"""Convolutions: values and hand-written gradients equal the compiler's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.model.convolution import Convolution


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
    params = layer.init(jax.random.key(0), x)["params"]
    params["bias"] = jnp.asarray(generator.standard_normal(6), jnp.float32)
    expected = reference(x, params["kernel"], params["bias"], strides)
    np.testing.assert_allclose(layer.apply({"params": params}, x), expected, atol=1e-5)

    weights = generator.standard_normal(expected.shape).astype(np.float32)
    ours = jax.grad(lambda p, x: (layer.apply({"params": p}, x) * weights).sum(), argnums=(0, 1))
    theirs = jax.grad(lambda p, x: (reference(x, p["kernel"], p["bias"], strides) * weights).sum(), argnums=(0, 1))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), ours(params, x), theirs(params, x))


def test_bfloat16_computes_in_bfloat16():
    x = np.ones((1, 4, 4, 3), np.float32)
    layer = Convolution(6, 3, "bfloat16")
    assert layer.apply(layer.init(jax.random.key(0), x), x).dtype == jnp.bfloat16
