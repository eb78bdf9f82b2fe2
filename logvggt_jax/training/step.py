"""One training step over all devices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.losses import Mean
from logvggt_jax.training.normalization import normalize_clips
from logvggt_jax.training.objective import loss_terms, progress_figures, total_loss
from logvggt_jax.training.optimizer import apply_updates, module_norms
from logvggt_jax.training.sharding import DATA_AXIS
from logvggt_jax.training.state import TrainState

Batch = dict[str, jax.Array]
Metrics = dict[str, jax.Array]
LossFunction = Callable[[Any, Batch], tuple[jax.Array, Metrics]]
TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def make_loss(model: LogVGGT, config: LossConfig) -> LossFunction:
    """The loss of parameters on one device's share of a batch; to be called within `shard_map`.

    Numerators and denominators are added over the devices *inside* the differentiated function. The result is
    the mean over the whole batch however its valid pixels are spread, and its gradient with respect to
    replicated parameters is complete: averaging it again would be wrong.
    """

    def loss(params: Any, batch: Batch) -> tuple[jax.Array, Metrics]:
        frame_mask = batch.get("frame_mask")
        predictions = model.apply({"params": params}, batch["images"], frame_mask, remat=True)
        targets = normalize_clips(batch["depth"], batch["intrinsics"], batch["extrinsics"], frame_mask=frame_mask)
        values = _global_means(loss_terms(predictions, targets, config))
        total = total_loss(values, config)
        figures = _global_means(progress_figures(jax.lax.stop_gradient(predictions), targets))
        figures["rotation_over_identity"] = figures["rotation"] / jnp.maximum(figures["identity_rotation"], 1e-6)
        logged = {f"loss/{name}": value for name, value in {"total": total, **values}.items()}
        return total, {**logged, **{f"train/{name}": value for name, value in figures.items()}}

    return loss


def make_train_step(
    loss: LossFunction,
    optimizer: optax.GradientTransformation,
    schedule: optax.Schedule,
    mesh: Mesh,
) -> TrainStep:
    """A jitted step (state, batch) -> (state, metrics); the state is donated, the batch split over `mesh`.

    A batch holds `images` uint8 [B, T, H, W, 3], `depth` [B, T, H, W], `intrinsics` [B, T, 3, 3], `extrinsics`
    [B, T, 4, 4] and optionally `frame_mask` bool [B, T]. Metrics are float32 scalars, equal on all devices. A
    non-finite loss or gradient leaves parameters and moments as they were and is counted in the state.
    """

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        (value, metrics), gradients = jax.value_and_grad(loss, has_aux=True)(state.params, batch)
        norms = module_norms(gradients)
        usable = jnp.isfinite(value)
        for norm in norms.values():
            usable &= jnp.isfinite(norm)
        learning_rate = jnp.asarray(schedule(state.step), jnp.float32)
        directions, opt_state = optimizer.update(gradients, state.opt_state, state.params)
        params = apply_updates(state.params, directions, learning_rate)

        def keep_if_usable(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, old)

        in_a_row = jnp.where(usable, 0, state.skipped_in_a_row + 1)
        new_state = TrainState(
            step=state.step + 1,
            params=keep_if_usable(params, state.params),
            opt_state=keep_if_usable(opt_state, state.opt_state),
            skipped=state.skipped + jnp.where(usable, 0, 1),
            skipped_in_a_row=in_a_row,
            longest_skip=jnp.maximum(state.longest_skip, in_a_row),
        )
        metrics = {**metrics, **{f"gradient_norm/{name}": norm for name, norm in norms.items()}}
        metrics |= {"learning_rate": learning_rate, "skipped": new_state.skipped.astype(jnp.float32)}
        metrics["longest_skip"] = new_state.longest_skip.astype(jnp.float32)
        return new_state, metrics

    sharded = jax.shard_map(step, mesh=mesh, in_specs=(P(), P(DATA_AXIS)), out_specs=(P(), P()))
    return jax.jit(sharded, donate_argnums=0)


class CompiledSteps:
    """The training step compiled ahead of time, once for each shape of batch.

    A compiled program cannot be traced again: a state or batch of another shape, type or placement raises
    instead of silently costing a second compilation.
    """

    def __init__(self, step: Any) -> None:
        self._step = step
        self._programs: dict[tuple[Any, ...], Any] = {}

    def has(self, batch: Batch) -> bool:
        """Whether batches of this shape have their program."""
        return _signature(batch) in self._programs

    def compile(self, state: TrainState, batch: Batch) -> None:
        """Compiles the step for batches of this shape."""
        self._programs[_signature(batch)] = self._step.lower(state, batch).compile()

    def __call__(self, state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        """Runs the program of the batch's shape; `state` is donated."""
        return self._programs[_signature(batch)](state, batch)


def _global_means(means: dict[str, Mean]) -> dict[str, jax.Array]:
    """Averages over the whole batch: sums over devices first, divided once."""
    return {name: mean.value() for name, mean in jax.lax.psum(means, DATA_AXIS).items()}


def _signature(batch: Batch) -> tuple[Any, ...]:
    return tuple((name, value.shape, value.dtype) for name, value in sorted(batch.items()))
