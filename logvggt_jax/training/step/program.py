"""The step that a run's settings ask for; training runs it, a dry run compiles it alone."""

import functools
from typing import Any, NamedTuple

import jax
import optax
from jax.sharding import Mesh

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.parallel.sharding import Layout, parameter_layout
from logvggt_jax.training.step.finite_check import make_finite_check
from logvggt_jax.training.step.freezing import frozen_leaves, frozen_patterns
from logvggt_jax.training.step.optimizer import learning_rate_schedule, make_optimizer
from logvggt_jax.training.step.state import TrainState, initial_state
from logvggt_jax.training.step.train_step import make_loss_terms, make_train_step


def abstract_parameters(config: ModelConfig) -> Any:
    """Shapes of what is trained: deep stacks are one loop over stacked layers, whose step compiles once for all."""
    return jax.eval_shape(stack_layers, variable_shapes(config)["params"])


class Program(NamedTuple):
    """What a run's settings ask for on a mesh."""

    layout: Layout
    optimizer: optax.GradientTransformation
    step: jax.stages.Wrapped  # of `make_train_step`
    abstract_state: TrainState  # shapes and places
    beside: jax.stages.Wrapped  # what the first state has beside parameters, of these
    finite_check: jax.stages.Wrapped  # of `make_finite_check`, compiled where it is needed

    def initial_state(self, params: Any) -> TrainState:
        """The state before the first step, of parameters on the host, in its place: no device holds a second copy."""
        placed = self.layout.put(params)
        state: TrainState = self.beside(placed)
        return state._replace(params=placed)


def make_program(model: LogVGGT, config: TrainConfig, params: Any, mesh: Mesh) -> Program:
    """The program for parameters of such shapes."""
    frozen = frozen_patterns(config)
    layout = parameter_layout(params, mesh, shard=config.shard_parameters)
    optimizer = make_optimizer(config.optimizer, params, frozen=frozen, norm=layout.norm)
    schedule = learning_rate_schedule(config.optimizer, config.stages)
    terms = make_loss_terms(model, config.loss, frozen=frozen)
    step = make_train_step(
        terms,
        config.loss,
        optimizer,
        schedule,
        layout,
        accumulate=config.accumulate,
        average=config.average,
    )
    still = {module: all(jax.tree.leaves(tree)) for module, tree in frozen_leaves(params, frozen).items()}
    averaged = () if config.average is None else tuple(module for module in params if not still[module])
    made = functools.partial(initial_state, optimizer=optimizer, averaged=averaged)
    shapes = jax.eval_shape(made, params)
    beside = jax.jit(
        lambda params: made(params)._replace(params=None), out_shardings=layout.shardings(shapes)._replace(params=None)
    )
    finite_check = make_finite_check(terms, config.loss, layout, accumulate=config.accumulate)
    return Program(layout, optimizer, step, layout.abstract(shapes), beside, finite_check)
