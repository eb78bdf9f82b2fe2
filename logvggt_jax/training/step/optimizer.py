"""AdamW and Muon with gradients clipped in each module by itself, and the schedule of the learning rate."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from optax.contrib import MuonDimensionNumbers, scale_by_muon

from logvggt_jax.training.config import OptimizerConfig, StageConfig
from logvggt_jax.training.step.freezing import frozen_leaves

Norm = Callable[[Any], jax.Array]
# Group of the parameters that are frozen in a module of which others are trained.
_FROZEN = "frozen"
# Root mean square of Muon's updates, about that of Adam's, so that one learning rate serves both.
_MUON_RMS = 0.2
_MUON_MOMENTUM = 0.95


def learning_rate_schedule(config: OptimizerConfig, stages: tuple[StageConfig, ...]) -> optax.Schedule:
    """The learning rate at each step of the run: one schedule over all stages, or a new one for each stage."""
    lengths = [stage.steps for stage in stages]
    if not config.restart_each_stage:
        lengths = [sum(lengths)]
    boundaries = [sum(lengths[: i + 1]) for i in range(len(lengths) - 1)]
    return optax.join_schedules([_schedule(config, length) for length in lengths], boundaries)


def make_optimizer(
    config: OptimizerConfig, params: Any, *, frozen: tuple[str, ...], norm: Norm = optax.tree.norm
) -> optax.GradientTransformation:
    """AdamW or Muon without the learning rate: the training step multiplies what it returns with that step's rate.

    `params` is a dict of modules (encoder, aggregator, heads). The gradient of each module is clipped to
    `config.clip_norm` by itself, so that one head with an exploding gradient does not slow down the others. Parameters
    matched by the patterns `frozen` (see `freezing`) do not move, and no moments are kept for them. `norm` is the
    l2 norm of a tree of gradients; where a device holds a part of each alone, it sums over the devices.

    Weight decay applies to the kernels of linear layers and convolutions: not to biases, norms, gains of residual
    branches, special tokens and the position embedding, unless `config.decay_all`.

    Sources: clipping by module as in VGGT's released trainer; Muon by Jordan et al. 2024 ("Muon: an optimizer for
    hidden layers"), with the scale of its updates by Liu et al. 2025 ("Muon is scalable for LLM training").
    """
    still = frozen_leaves(params, frozen)
    groups: dict[str, optax.GradientTransformation] = {}
    labels: dict[str, Any] = {}
    for module, leaves in still.items():
        whole = all(jax.tree.leaves(leaves))
        groups[module] = optax.set_to_zero() if whole else _module_optimizer(config, norm)
        apart = module if whole else _FROZEN
        labels[module] = jax.tree.map(lambda frozen, own=module, apart=apart: apart if frozen else own, leaves)
    # A group that no parameter is in would only change what checkpoints hold.
    if _FROZEN in jax.tree.leaves(labels):
        groups[_FROZEN] = optax.set_to_zero()
    return optax.partition(groups, labels)


def apply_updates(params: Any, directions: Any, learning_rate: jax.Array) -> Any:
    """params - learning_rate * directions."""
    return jax.tree.map(lambda p, u: (p - learning_rate * u).astype(p.dtype), params, directions)


def moving_average(average: Any, params: Any, decay: float | None) -> Any:
    """decay * average + (1 - decay) * params for the modules in `average`; None where none is kept."""
    if average is None or decay is None:
        return average
    return {
        module: jax.tree.map(lambda a, p: (a + (1 - decay) * (p - a)).astype(a.dtype), tree, params[module])
        for module, tree in average.items()
    }


def module_norms(gradients: Any, norm: Norm = optax.tree.norm) -> dict[str, jax.Array]:
    """l2 norm of each module's gradient."""
    return {module: norm({module: tree}) for module, tree in gradients.items()}


def _schedule(config: OptimizerConfig, steps: int) -> optax.Schedule:
    """The learning rate at each of so many steps: warm-up, then a cosine, or a level line that falls in the last
    quarter."""
    warmup = round(config.warmup_fraction * steps)
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0, config.learning_rate, warmup, max(steps, warmup + 1), end_value=config.final_learning_rate
        )
    tail = steps - steps // 4
    return optax.join_schedules(
        [
            optax.linear_schedule(0.0, config.learning_rate, warmup),
            optax.constant_schedule(config.learning_rate),
            optax.linear_schedule(config.learning_rate, config.final_learning_rate, steps - tail),
        ],
        [warmup, tail],
    )


def _clip(limit: float, norm: Norm) -> optax.GradientTransformation:
    """`optax.clip_by_global_norm` with a norm that knows where the gradients lie."""

    def update(updates: Any, state: optax.EmptyState, params: Any = None) -> tuple[Any, optax.EmptyState]:
        del params
        length = norm(updates)
        factor = jnp.where(length < limit, 1.0, limit / length)
        return jax.tree.map(lambda x: x * factor.astype(x.dtype), updates), state

    return optax.GradientTransformation(lambda _: optax.EmptyState(), update)


def _module_optimizer(config: OptimizerConfig, norm: Norm) -> optax.GradientTransformation:
    """Clipping, Adam or Muon, and weight decay, which the leaves named `kernel` have, of one module."""

    def decayed(tree: Any) -> Any:
        return jax.tree_util.tree_map_with_path(lambda path, _: config.decay_all or path[-1].key == "kernel", tree)

    adam = optax.scale_by_adam(config.b1, config.b2)
    return optax.chain(
        _clip(config.clip_norm, norm),
        adam if config.algorithm == "adamw" else optax.partition({"adam": adam, "muon": _muon()}, _by_muon),
        optax.add_decayed_weights(config.weight_decay, decayed),
    )


def _by_muon(tree: Any) -> Any:
    """ "muon" for the matrices of linear layers, alone [in, out] or stacked [layers, in, out], "adam" for the rest."""

    def label(path: Any, leaf: Any) -> str:
        return "muon" if path[-1].key == "kernel" and leaf.ndim in (2, 3) else "adam"

    return jax.tree_util.tree_map_with_path(label, tree)


def _muon() -> optax.GradientTransformation:
    """The orthogonalised momentum of every matrix."""

    def matrices(tree: Any) -> Any:
        return jax.tree.map(lambda x: MuonDimensionNumbers(x.ndim - 2, x.ndim - 1), tree)

    def scaled(updates: Any, _: Any) -> Any:
        # The values of an orthogonal matrix [in, out] have a root mean square of max(in, out)^-1/2.
        return jax.tree.map(lambda x: _MUON_RMS * max(x.shape[-2:]) ** 0.5 * x, updates)

    return optax.chain(scale_by_muon(beta=_MUON_MOMENTUM, weight_dimension_numbers=matrices), optax.stateless(scaled))
