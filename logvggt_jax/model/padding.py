"""Arrays that get empty places at their end, and how many they have."""

import jax
import jax.numpy as jnp


def with_places(x: jax.Array, room: int, *, axis: int) -> jax.Array:
    """`x` followed by `room` zeros along an axis, counted from the first."""
    return jnp.pad(x, [(0, room if i == axis else 0) for i in range(x.ndim)])


def doubled(capacity: int, wanted: int) -> int:
    """The first of `capacity`, twice it, four times it … that is at least `wanted`."""
    while capacity < wanted:
        capacity *= 2
    return capacity
