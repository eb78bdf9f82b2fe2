"""The value of a rank among many, without sorting them: sorts are slow on every kind of device."""

import jax
import jax.numpy as jnp
import numpy as np

_BITS = 32
_HIGHEST = np.uint32(0x80000000)
_ALL = np.uint32(0xFFFFFFFF)


def order_statistic(values: jax.Array, rank: jax.Array) -> jax.Array:
    """float32 [B]: what stands at place `rank` [B] (int, from 0) of each ascending row of float32 `values` [B, N].

    NaN comes last, as in `jnp.sort`. The result is found bit by bit, the highest first: a bit is set where no more
    than `rank` values lie below the number that it would give.
    """
    keys = _ascending_keys(values)

    def with_next_bit(place: jax.Array, found: jax.Array) -> jax.Array:
        tried = found | _HIGHEST >> place.astype(jnp.uint32)
        return jnp.where((keys < tried[:, None]).sum(-1) <= rank, tried, found)

    none = jnp.zeros_like(keys[:, 0])
    return _value_of(jax.lax.fori_loop(0, _BITS, with_next_bit, none))


def _ascending_keys(values: jax.Array) -> jax.Array:
    """uint32 in the order of float32 `values`: floats of one sign are ordered as their bits are, or the other way."""
    bits = jax.lax.bitcast_convert_type(values, jnp.uint32)
    keys = bits ^ jnp.where(bits < _HIGHEST, _HIGHEST, _ALL)
    return jnp.where(jnp.isnan(values), _ALL, keys)


def _value_of(keys: jax.Array) -> jax.Array:
    """The float32 of which `_ascending_keys` made `keys`."""
    bits = keys ^ jnp.where(keys < _HIGHEST, _ALL, _HIGHEST)
    return jax.lax.bitcast_convert_type(bits, jnp.float32)
