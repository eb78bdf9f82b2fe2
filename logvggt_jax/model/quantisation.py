"""Four-bit codes of keys and values, two in a byte, as XStreamVGGT groups them.

A group shares a scale and a zero point, so that code c stands for (c − zero) · scale:

    scale = (max − min) / 15,   zero = clip(round(−min / scale), 0, 15),   c = clip(round(x / scale) + zero, 0, 15)

Keys form groups of 64 tokens, each channel for itself, since outliers sit in channels; values form one group a token
and head. As in the original the interval that a group can represent contains 0 and is as wide as the group's range: a
group that lies on one side of 0 is cut to its range, and a constant one becomes 0.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

GROUP = 64
_LEVELS = 15
# Of a constant group: what it becomes is 0 for all purposes.
_LEAST_SCALE = 1e-12


@struct.dataclass
class Codes:
    """Codes of numbers before they are packed.

    Attributes:
      code: uint8 [...], 0 to 15.
      scale: float32, of the code's shape but for the axis of a group, which is 1.
      zero: uint8, of the scale's shape.
    """

    code: jax.Array
    scale: jax.Array
    zero: jax.Array

    def numbers(self) -> jax.Array:
        """What the codes stand for, float32."""
        return decoded(self.code, self.scale, self.zero)


def decoded(code: jax.Array, scale: jax.Array, zero: jax.Array) -> jax.Array:
    """float32 numbers of codes with the scale and zero point of their groups, all of one shape or broadcast to it."""
    return (code.astype(jnp.float32) - zero.astype(jnp.float32)) * scale


def encoded(numbers: jax.Array, axis: int) -> Codes:
    """Codes of float32 numbers [...]; a group runs along `axis`."""
    low, high = numbers.min(axis, keepdims=True), numbers.max(axis, keepdims=True)
    scale = jnp.maximum(_divided(high - low, _LEVELS), _LEAST_SCALE)
    zero = jnp.clip(jnp.round(_divided(-low, scale)), 0, _LEVELS)
    code = jnp.clip(jnp.round(_divided(numbers, scale)) + zero, 0, _LEVELS)
    return Codes(code.astype(jnp.uint8), scale, zero.astype(jnp.uint8))


def _divided(x: jax.Array, divisor: jax.Array | int) -> jax.Array:
    """x / divisor, rounded once.

    XLA makes a division by a constant, or by one number for many, a product with the reciprocal, which rounds twice.
    Numbers that are coded again lie on their former group's grid, often midway between two codes of the new one, and
    there the last digit decides. A divisor that might be another for each number is not replaced.
    """
    return x / jnp.where(jnp.isnan(x), x, divisor)


def encoded_keys(keys: jax.Array) -> Codes:
    """Codes of keys [B, N, heads, head_dim] in groups along the tokens: code [B, G, 64, heads, head_dim] of G groups,
    the last one filled up with zeros."""
    batch, tokens, *rest = keys.shape
    groups = num_groups(tokens)
    padded = jnp.pad(keys.astype(jnp.float32), ((0, 0), (0, groups * GROUP - tokens), (0, 0), (0, 0)))
    return encoded(padded.reshape(batch, groups, GROUP, *rest), axis=2)


def encoded_values(values: jax.Array) -> Codes:
    """Codes of values [B, N, heads, head_dim], a group for each token and head."""
    return encoded(values.astype(jnp.float32), axis=-1)


def num_groups(tokens: int) -> int:
    """Groups of keys of so many tokens."""
    return -(-tokens // GROUP)


def packed(code: jax.Array) -> jax.Array:
    """Codes [..., D] as bytes [..., D / 2]: the first half of the channels in the low bits, the second in the high."""
    low, high = jnp.split(code, 2, axis=-1)
    return low | (high << 4)


def unpacked(bytes_: jax.Array) -> jax.Array:
    """Codes [..., D] of bytes [..., D / 2]."""
    return jnp.concatenate([bytes_ & 15, bytes_ >> 4], axis=-1)
