"""A model whose predictions for some pictures are not finite, for tests in this process and in others."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class DazzledModel:
    """The quick model, which a black picture drives to infinity."""

    config: Any
    model: Any

    def apply(self, variables: Any, images: jax.Array, *given: Any, **options: Any) -> Any:
        predictions = self.model.apply(variables, images, *given, **options)
        dark = images.astype(jnp.float32).sum((1, 2, 3, 4)) == 0
        depth = jnp.where(dark[:, None, None, None], jnp.inf, predictions.depth)
        return dataclasses.replace(predictions, depth=depth)
