"""Arrays that get empty places at their end."""

import jax
import jax.numpy as jnp


def with_places(x: jax.Array, room: int, *, axis: int) -> jax.Array:
    """`x` followed by `room` zeros along an axis, counted from the first."""
    return jnp.pad(x, [(0, room if i == axis else 0) for i in range(x.ndim)])
