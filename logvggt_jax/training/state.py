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


def initial_state(params: Any, optimizer: optax.GradientTransformation) -> TrainState:
    """The state before the first step."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        opt_state=optimizer.init(params),
        skipped=jnp.zeros((), jnp.int32),
        skipped_in_a_row=jnp.zeros((), jnp.int32),
        longest_skip=jnp.zeros((), jnp.int32),
    )
