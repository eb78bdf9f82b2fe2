"""The step that a run's settings ask for; training runs it, a dry run compiles it alone."""

from typing import Any

import jax
import optax
from jax.sharding import Mesh

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.logvggt import LogVGGT, variable_shapes
from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.training.config import TrainConfig
from logvggt_jax.training.optimizer import learning_rate_schedule, make_optimizer
from logvggt_jax.training.step import make_loss_terms, make_train_step


def abstract_parameters(config: ModelConfig) -> Any:
    """Shapes of what is trained: deep stacks are one loop over stacked layers, whose step compiles once for all."""
    return jax.eval_shape(stack_layers, variable_shapes(config)["params"])


def make_program(
    model: LogVGGT, config: TrainConfig, params: Any, mesh: Mesh
) -> tuple[optax.GradientTransformation, jax.stages.Wrapped]:
    """The optimiser for such parameters, shapes or values, and the jitted step."""
    frozen = ("encoder",) if config.model.encoder.frozen else ()
    optimizer = make_optimizer(config.optimizer, params, frozen=frozen)
    schedule = learning_rate_schedule(config.optimizer, config.stages)
    terms = make_loss_terms(model, config.loss)
    return optimizer, make_train_step(terms, config.loss, optimizer, schedule, mesh)
