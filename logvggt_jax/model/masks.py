"""Masks of pixels that are not to be seen: people, sky, dirt on the lens, a car's bonnet.

A mask is True where a pixel counts. What lies under it stays out of the model in three steps:

    pixels    become the mean colour of the encoder's training images, which its normalisation turns into zero: nothing
              of what they showed gets any further
    patches   of which more than half is masked are no keys in any attention, of encoder, frames, windows or cache. They
              remain queries: their tokens take in what is around them, and the dense heads' convolutions find something
              plausible there
    outputs   are 0 there, depth and confidence alike
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from logvggt_jax.model.dinov2 import IMAGE_MEAN

# The share of a patch that may be masked before nothing attends to it.
_MOST_MASKED = 0.5


def without_masked(pixels: jax.Array, masks: jax.Array | None) -> jax.Array:
    """Pixels [..., H, W, 3] float32 in [0, 1] with those that `masks`, bool [..., H, W], drops in the mean colour."""
    return pixels if masks is None else jnp.where(masks[..., None], pixels, IMAGE_MEAN)


def seen_patches(masks: jax.Array | None, patch_size: int) -> jax.Array | None:
    """The patches that may be attended to, bool [..., h · w] row by row, of masks bool [..., H, W]; None for all."""
    if masks is None:
        return None
    *leading, height, width = masks.shape
    tiles = masks.reshape(*leading, height // patch_size, patch_size, width // patch_size, patch_size)
    seen = (~tiles).mean((-3, -1)) <= _MOST_MASKED
    return seen.reshape(*leading, -1)


def zero_where_masked(values: jax.Array, masks: jax.Array | None) -> jax.Array:
    """Values [B, n, H, W, …] of which those that `masks`, bool [B, n, H, W], drops are 0."""
    if masks is None:
        return values
    return jnp.where(masks.reshape(*masks.shape, *(1,) * (values.ndim - masks.ndim)), values, 0)
