"""Parameters are read by their shapes alone, and one of another shape is refused."""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.errors import ScopeParamShapeError

from logvggt_jax.model.layers import dense
from logvggt_jax.model.shape_check import ShapeCheck


class Shifted(ShapeCheck, nn.Module):
    """x plus a parameter."""

    begin: Callable[..., jax.Array]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return x + self.param("shift", self.begin, (x.shape[-1],))


def test_a_parameter_that_is_given_does_not_begin_again() -> None:
    begun: list[tuple[int, ...]] = []

    def begin(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        begun.append(shape)
        return jnp.ones(shape)

    module, x = Shifted(begin), np.zeros((2, 3), np.float32)
    variables = module.init(jax.random.key(0), x)
    np.testing.assert_array_equal(module.apply(variables, x), np.ones((2, 3)))
    assert begun == [(3,)]


def test_another_shape_is_refused() -> None:
    x = np.zeros((2, 3), np.float32)
    with pytest.raises(ScopeParamShapeError, match="shift"):
        Shifted(nn.initializers.ones).apply({"params": {"shift": np.ones(4, np.float32)}}, x)
    kernel = {"kernel": np.ones((3, 5), np.float32), "bias": np.ones(4, np.float32)}
    with pytest.raises(ScopeParamShapeError, match="kernel"):
        dense(4, "linear").apply({"params": kernel}, x)
