"""What a training step takes and returns."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax


class TrainState(NamedTuple):
    """State of a run; donated to every step."""

    step: jax.Array  # int32 scalar, batches seen
    params: Any  # Parameter tree of the model, float32, the layers of deep stacks as one (`stack_layers`)
    opt_state: Any  # The optimiser's
    skipped: jax.Array  # int32 scalar, updates left out for a non-finite loss or gradient
    skipped_in_a_row: jax.Array  # int32 scalar
    longest_skip: jax.Array  # int32 scalar, the longest row so far
    # The moving average of the modules that are trained, {module: parameters}; None where none is kept.
    average: Any = None

    @property
    def averaged(self) -> Any:
        """The parameters to be used after training: averages where they are kept."""
        return self.params if self.average is None else {**self.params, **self.average}


def initial_state(
    params: Any, optimizer: optax.GradientTransformation, *, averaged: tuple[str, ...] = ()
) -> TrainState:
    """The state before the first step; a moving average is kept of the modules `averaged`, none where empty."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        opt_state=optimizer.init(params),
        skipped=jnp.zeros((), jnp.int32),
        skipped_in_a_row=jnp.zeros((), jnp.int32),
        longest_skip=jnp.zeros((), jnp.int32),
        # Copies: a step is given both to overwrite.
        average={module: jax.tree.map(jnp.copy, params[module]) for module in averaged} or None,
    )
