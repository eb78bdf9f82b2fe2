"""One training step over all devices."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import PartitionSpec as P

from logvggt_jax.compile import quick_compilation
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.losses.clip_errors import clip_errors
from logvggt_jax.training.losses.mean import Mean
from logvggt_jax.training.losses.normalization import Targets, normalize_clips
from logvggt_jax.training.losses.objective import loss_terms, total_loss
from logvggt_jax.training.parallel.sharding import DATA_AXIS, Layout
from logvggt_jax.training.step.freezing import without_gradient
from logvggt_jax.training.step.optimizer import apply_updates, module_norms, moving_average
from logvggt_jax.training.step.state import TrainState
from logvggt_jax.types import Predictions

Batch = dict[str, jax.Array]
Metrics = dict[str, jax.Array]
LossTerms = Callable[[Any, Batch], tuple[dict[str, Mean], dict[str, Mean], jax.Array]]


def make_loss_terms(model: LogVGGT, config: LossConfig, *, frozen: tuple[str, ...] = ()) -> LossTerms:
    """A function (parameters, one device's share of a batch) -> (terms of the objective, errors to be logged, bool [b]
    which clips are finite in predictions, targets and terms).

    Both are sums and counts over that share alone, so the function holds no communication of its own and can be
    differentiated on each device by itself. What the patterns `frozen` match has no gradient.
    """

    def terms(params: Any, batch: Batch) -> tuple[dict[str, Mean], dict[str, Mean], jax.Array]:
        frame_mask = batch.get("frame_mask")
        variables = {"params": without_gradient(params, frozen)}
        predictions = model.apply(variables, batch["images"], frame_mask, remat=True)
        targets = normalize_clips(batch["depth"], batch["intrinsics"], batch["extrinsics"], frame_mask=frame_mask)
        seen: Any = jax.lax.stop_gradient(predictions)
        confidence = batch.get("confidence")
        means = loss_terms(predictions, targets, config, confidence)
        # A clip's own terms overflow where its finite predictions are far off.
        finite = _finite_clips(seen, targets)
        for mean in means.values():
            if mean.numerator.ndim:
                finite &= jnp.isfinite(mean.numerator)
        return _summed(means), _summed(clip_errors(seen, targets)), finite

    return terms


def loss_and_gradients(
    terms: LossTerms, config: LossConfig, params: Any, batch: Batch, layout: Layout, *, accumulate: int = 1
) -> tuple[jax.Array, Metrics, Any, jax.Array]:
    """The objective over the whole batch, what is logged of it, its gradient, and which clips are finite, bool [b]; to
    be called within `shard_map`, with this device's part of the parameters and of the batch.

    Every term is a quotient of sums over all devices, and its denominator does not depend on the parameters. So each
    device differentiates its own numerators alone; sums over devices are taken outside of what is differentiated,
    where no rule of differentiation can count them twice. The result is that of one device with the whole batch,
    however unevenly the valid pixels are spread.

    With `accumulate` a device takes its clips in so many parts, one after the other, and the result is that of so many
    times the devices.
    """

    def numerators(params: Any, batch: Batch) -> tuple[dict[str, jax.Array], Any]:
        means, errors, finite = terms(layout.in_parts(params), batch)
        denominators = {name: mean.denominator for name, mean in means.items()}
        return {name: mean.numerator for name, mean in means.items()}, (denominators, errors, finite)

    def objective(
        numerators: dict[str, jax.Array], denominators: dict[str, jax.Array]
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        values = {name: Mean(value, denominators[name]).value() for name, value in numerators.items()}
        return total_loss(values, config), values

    if accumulate == 1:
        local, pull_back, (*sums, finite) = jax.vjp(lambda params: numerators(params, batch), params, has_aux=True)
        summed, (denominators, errors) = jax.lax.psum((local, sums), DATA_AXIS)
        (total, values), weights = jax.value_and_grad(objective, has_aux=True)(summed, denominators)
        gradients = pull_back(weights)[0]
    else:
        parts = jax.tree.map(lambda x: x.reshape(accumulate, -1, *x.shape[1:]), batch)
        # The objective is linear in the numerators, so that the denominators alone give the weights of the gradients.
        # The model's pass in here leads to nothing that is used, and the compiler leaves it out.
        each = jax.lax.map(lambda part: numerators(params, part)[1][0], parts)
        denominators = jax.lax.psum(jax.tree.map(lambda x: x.sum(0), each), DATA_AXIS)
        weights = jax.grad(objective, has_aux=True)(jax.tree.map(jnp.zeros_like, denominators), denominators)[0]

        def add(gradients: Any, part: Batch) -> tuple[Any, Any]:
            local, pull_back, (_, errors, finite) = jax.vjp(
                lambda params: numerators(params, part), params, has_aux=True
            )
            return jax.tree.map(jnp.add, gradients, pull_back(weights)[0]), (local, errors, finite)

        gradients, (*lists, finite) = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), parts)
        summed, errors = jax.lax.psum(jax.tree.map(lambda x: x.sum(0), lists), DATA_AXIS)
        total, values = objective(summed, denominators)
    progress = {name: mean.value() for name, mean in errors.items()}
    progress["rotation_over_identity"] = progress["rotation"] / jnp.maximum(progress["identity_rotation"], 1e-6)
    metrics = {f"loss/{name}": value for name, value in {"total": total, **values}.items()}
    metrics |= {f"train/{name}": value for name, value in progress.items()}
    return total, metrics, layout.sum(gradients), finite.reshape(-1)


def make_train_step(
    terms: LossTerms,
    config: LossConfig,
    optimizer: optax.GradientTransformation,
    schedule: optax.Schedule,
    layout: Layout,
    *,
    accumulate: int = 1,
    average: float | None = None,
) -> jax.stages.Wrapped:
    """A jitted step (state, batch) -> (state, metrics, finite clips); the state is donated, the batch split over the
    mesh.

    A batch holds `images` uint8 [B, T, H, W, 3], `depth` [B, T, H, W], `intrinsics` [B, T, 3, 3], `extrinsics`
    [B, T, 4, 4], optionally `frame_mask` bool [B, T], and for a distillation the teacher's `confidence` [B, T, H, W].
    Metrics are float32 scalars, equal on all devices. A non-finite loss or gradient leaves parameters and moments as
    they were and is counted in the state; where it comes from predictions, targets or the loss of single clips, `finite
    clips`, bool [B] and split as the batch is, says of which clips. Of the gradient `make_finite_check` says it.

    State and optimiser lie as `layout` says. `accumulate`: see `loss_and_gradients`. `average` is the decay of the
    moving average in a step, for a state that has one.
    """

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics, jax.Array]:
        total, metrics, gradients, finite = loss_and_gradients(
            terms, config, state.params, batch, layout, accumulate=accumulate
        )
        norms = module_norms(gradients, layout.norm)
        usable = all_finite(total, norms)
        learning_rate = jnp.asarray(schedule(state.step), jnp.float32)
        directions, opt_state = optimizer.update(gradients, state.opt_state, state.params)
        params = apply_updates(state.params, directions, learning_rate)

        # Not `optax.apply_if_finite`, which looks at the gradient alone and knows neither average nor longest row.
        def keep_if_usable(new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, old)

        in_a_row = jnp.where(usable, 0, state.skipped_in_a_row + 1)
        params = keep_if_usable(params, state.params)
        new_state = TrainState(
            step=state.step + 1,
            params=params,
            opt_state=keep_if_usable(opt_state, state.opt_state),
            skipped=state.skipped + jnp.where(usable, 0, 1),
            skipped_in_a_row=in_a_row,
            longest_skip=jnp.maximum(state.longest_skip, in_a_row),
            average=keep_if_usable(moving_average(state.average, params, average), state.average),
        )
        metrics = {**metrics, **{f"gradient_norm/{name}": norm for name, norm in norms.items()}}
        metrics |= {"learning_rate": learning_rate, "skipped": new_state.skipped.astype(jnp.float32)}
        metrics["longest_skip"] = new_state.longest_skip.astype(jnp.float32)
        return new_state, metrics, finite

    def on_all_devices(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics, jax.Array]:
        specs = layout.specs(state)
        return jax.shard_map(
            step,
            mesh=layout.mesh,
            in_specs=(specs, P(DATA_AXIS)),
            out_specs=(specs, P(), P(DATA_AXIS)),
            check_vma=False,
        )(state, batch)

    options = quick_compilation(layout.mesh.devices.flat[0])
    return jax.jit(on_all_devices, donate_argnums=0, compiler_options=options)


def all_finite(total: jax.Array, norms: dict[str, jax.Array]) -> jax.Array:
    """bool scalar: whether an objective and the norms of its gradient, module by module, are finite."""
    # One reduction, which the compiler does not repeat in the update of every parameter.
    return jnp.isfinite(jnp.stack([total, *norms.values()])).all()


def _finite_clips(predictions: Predictions, targets: Targets) -> jax.Array:
    """bool [b]: whether a clip's predictions and targets are finite in the frames that count."""
    depth = jnp.isfinite(predictions.depth) & jnp.isfinite(predictions.depth_confidence) & jnp.isfinite(targets.depth)
    poses = jnp.isfinite(predictions.pose_encodings).all((-2, -1)) & jnp.isfinite(targets.pose_encoding).all(-1)
    return ((depth.all((-2, -1)) & poses) | ~targets.frame_valid).all(-1)


def _summed(means: dict[str, Mean]) -> dict[str, Mean]:
    return {name: mean.sum() for name, mean in means.items()}
