"""Initial values of parameters that compile a handful of kernels for a whole model.

A random generator takes the compiler a good part of a second, and Flax's initializers need several for every new
shape: more than the first forward pass of a model. Here values are drawn in power-of-two lengths that shapes share.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Initializer = Callable[..., jax.Array]


@functools.partial(jax.jit, static_argnums=1)
def _standard_normal(key: jax.Array, length: int) -> jax.Array:
    return jax.random.normal(key, (length,), jnp.float32)


@functools.partial(jax.jit, static_argnums=2)
def _scaled(values: jax.Array, stddev: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return stddev * values[: math.prod(shape)].reshape(shape)


def normal(stddev: float) -> Initializer:
    """Zero-mean normal values."""

    def initialize(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
        length = max(4096, 1 << (math.prod(shape) - 1).bit_length())
        return _scaled(_standard_normal(key, length), stddev, tuple(shape)).astype(dtype)

    return initialize


def fan_in_normal(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    """Normal values of variance 1 / fan-in for a kernel [..., in, out] (LeCun)."""
    return normal(1.0 / math.sqrt(math.prod(shape[:-1])))(key, shape, dtype)


def constant(value: float) -> Initializer:
    """The same value everywhere; made on the host, and placed as other values of the context are.

    Where no mesh is set it is copied as it is, for which nothing is compiled: `asarray` would hand a value that is made
    while others are traced to a program, one for each shape.
    """

    def initialize(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
        del key
        values = np.full(shape, value, dtype)
        return jax.device_put(values) if jax.sharding.get_abstract_mesh().empty else jnp.asarray(values)

    return initialize
