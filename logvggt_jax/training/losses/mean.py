"""Means as sums and counts, so that devices can add theirs before dividing."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Mean(NamedTuple):
    """A mean that is not divided yet: `numerator` and `denominator`, float32 scalars.

    Means over different numbers of valid pixels cannot be averaged; their numerators and denominators can be added.
    """

    numerator: jax.Array
    denominator: jax.Array

    def value(self) -> jax.Array:
        """numerator / denominator, 0 (with zero gradient) where nothing was counted."""
        return self.numerator / jnp.maximum(self.denominator, 1.0)
