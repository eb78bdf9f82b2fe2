"""One training step over all devices."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training.clip_errors import clip_errors
from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.losses import Mean
from logvggt_jax.training.normalization import normalize_clips
from logvggt_jax.training.objective import loss_terms, total_loss
from logvggt_jax.training.optimizer import apply_updates, module_norms
from logvggt_jax.training.sharding import DATA_AXIS
from logvggt_jax.training.state import TrainState

Batch = dict[str, jax.Array]
Metrics = dict[str, jax.Array]
LossTerms = Callable[[Any, Batch], tuple[dict[str, Mean], dict[str, Mean]]]


def make_loss_terms(model: LogVGGT, config: LossConfig) -> LossTerms:
    """A function (parameters, one device's share of a batch) -> (terms of the objective, errors to be logged).

    Both are sums and counts over that share alone, so the function holds no communication and can be differentiated
    on each device by itself.
    """

    def terms(params: Any, batch: Batch) -> tuple[dict[str, Mean], dict[str, Mean]]:
        frame_mask = batch.get("frame_mask")
        predictions = model.apply({"params": params}, batch["images"], frame_mask, remat=True)
        targets = normalize_clips(batch["depth"], batch["intrinsics"], batch["extrinsics"], frame_mask=frame_mask)
        errors = clip_errors(jax.lax.stop_gradient(predictions), targets)
        return loss_terms(predictions, targets, config), errors

    return terms


def loss_and_gradients(
    terms: LossTerms, config: LossConfig, params: Any, batch: Batch
) -> tuple[jax.Array, Metrics, Any]:
    """The objective over the whole batch, what is logged of it, and its gradient; to be called within `shard_map`.

    Every term is a quotient of sums over all devices, and its denominator does not depend on the parameters. So each
    device differentiates its own numerators alone; sums over devices are taken outside of what is differentiated,
    where no rule of differentiation can count them twice. The result is that of one device with the whole batch,
    however unevenly the valid pixels are spread.
    """

    def numerators(params: Any) -> tuple[dict[str, jax.Array], Any]:
        means, errors = terms(params, batch)
        denominators = {name: mean.denominator for name, mean in means.items()}
        return {name: mean.numerator for name, mean in means.items()}, (denominators, errors)

    local, pull_back, sums = jax.vjp(numerators, params, has_aux=True)
    summed, (denominators, errors) = jax.lax.psum((local, sums), DATA_AXIS)

    def objective(numerators: dict[str, jax.Array]) -> tuple[jax.Array, Metrics]:
        values = {name: Mean(value, denominators[name]).value() for name, value in numerators.items()}
        return total_loss(values, config), values

    (total, values), weights = jax.value_and_grad(objective, has_aux=True)(summed)
    gradients = jax.lax.psum(pull_back(weights)[0], DATA_AXIS)
    progress = {name: mean.value() for name, mean in errors.items()}
    progress["rotation_over_identity"] = progress["rotation"] / jnp.maximum(progress["identity_rotation"], 1e-6)
    metrics = {f"loss/{name}": value for name, value in {"total": total, **values}.items()}
    return total, metrics | {f"train/{name}": value for name, value in progress.items()}, gradients


def make_train_step(
    terms: LossTerms, config: LossConfig, optimizer: optax.GradientTransformation, schedule: optax.Schedule, mesh: Mesh
) -> jax.stages.Wrapped:
    """A jitted step (state, batch) -> (state, metrics); the state is donated, the batch split over `mesh`.

    A batch holds `images` uint8 [B, T, H, W, 3], `depth` [B, T, H, W], `intrinsics` [B, T, 3, 3], `extrinsics`
    [B, T, 4, 4] and optionally `frame_mask` bool [B, T]. Metrics are float32 scalars, equal on all devices. A
    non-finite loss or gradient leaves parameters and moments as they were and is counted in the state.
    """

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        total, metrics, gradients = loss_and_gradients(terms, config, state.params, batch)
        norms = module_norms(gradients)
        usable = jnp.isfinite(total)
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

    sharded = jax.shard_map(step, mesh=mesh, in_specs=(P(), P(DATA_AXIS)), out_specs=(P(), P()), check_vma=False)
    return jax.jit(sharded, donate_argnums=0)
