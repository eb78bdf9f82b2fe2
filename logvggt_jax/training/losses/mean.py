"""Means as sums and counts, so that clips and devices can add theirs before dividing."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Mean(NamedTuple):
    """A mean that is not divided yet: `numerator` and `denominator`, float32 sums of each clip [B], or of all.

    Means over different numbers of valid pixels cannot be averaged; their numerators and denominators can be added.
    """

    numerator: jax.Array
    denominator: jax.Array

    def sum(self) -> "Mean":
        """The sums of all clips."""
        return Mean(self.numerator.sum(), self.denominator.sum())

    def value(self) -> jax.Array:
        """The mean over all clips, 0 (with zero gradient) where nothing was counted."""
        total = self.sum()
        return total.numerator / jnp.maximum(total.denominator, 1.0)
