"""Parameters frozen by patterns: they do not move, cost the optimiser nothing, and patterns that miss are named."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import LossConfig, OptimizerConfig
from logvggt_jax.training.parallel.sharding import data_mesh, parameter_layout, put_batch
from logvggt_jax.training.step.freezing import frozen_leaves, without_gradient
from logvggt_jax.training.step.optimizer import make_optimizer
from logvggt_jax.training.step.state import initial_state
from logvggt_jax.training.step.train_step import make_loss_terms, make_train_step

PARAMS = {
    "aggregator": {"frame_blocks": {"mlp": {"kernel": jnp.ones((3, 2)), "bias": jnp.ones(3)}}, "token": jnp.ones(2)},
    "camera_head": {"kernel": jnp.ones((2, 2))},
}


def test_patterns_reach_through_the_tree() -> None:
    def frozen(*patterns: str) -> list[bool]:
        return jax.tree.leaves(frozen_leaves(PARAMS, patterns))

    assert frozen("aggregator/*") == [True, True, True, False]
    assert frozen("*/bias", "*token") == [True, False, True, False]
    assert frozen() == [False] * 4


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        (("aggregator/*", "camera"), r"no parameter matches 'camera'; names are such as aggr"),
        (("*",), "leaves nothing"),
    ],
)
def test_patterns_that_miss_or_take_all_are_refused(patterns: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        frozen_leaves(PARAMS, patterns)


def test_what_is_frozen_in_a_module_has_no_moments(optimizer_config: OptimizerConfig) -> None:
    optimizer = make_optimizer(optimizer_config, PARAMS, frozen=("aggregator/frame_blocks/*",))
    moments = sum(leaf.size for leaf in jax.tree.leaves(optimizer.init(PARAMS)) if leaf.ndim)
    assert moments == 2 * (2 + 4)
    directions, _ = optimizer.update(PARAMS, optimizer.init(PARAMS), PARAMS)
    assert not jax.tree.leaves(directions["aggregator"]["frame_blocks"])[0].any()
    assert directions["aggregator"]["token"].all() and directions["camera_head"]["kernel"].all()


def test_no_gradient_is_computed_for_what_is_frozen() -> None:
    def value(params: Any) -> jax.Array:
        return sum(leaf.sum() for leaf in jax.tree.leaves(without_gradient(params, ("*/bias", "camera_head/*"))))

    gradients = jax.grad(value)(PARAMS)
    assert [bool(leaf.all()) for leaf in jax.tree.leaves(gradients)] == [False, True, True, False]


def test_a_step_leaves_a_frozen_part_of_a_module_where_it_is(
    pixel_model: Any, pixel_params: Any, loss_config: LossConfig, optimizer_config: OptimizerConfig, clips: Any
) -> None:
    frozen = ("encoder/*", "camera_head/bias")
    layout = parameter_layout(pixel_params, data_mesh(2), shard=False)
    optimizer = make_optimizer(dataclasses.replace(optimizer_config, frozen=frozen), pixel_params, frozen=frozen)
    terms = make_loss_terms(pixel_model, loss_config, frozen=frozen)
    step = make_train_step(terms, loss_config, optimizer, lambda _: jnp.float32(1e-2), layout)
    state = initial_state(jax.tree.map(jnp.array, pixel_params), optimizer)
    state, *_ = step(jax.device_put(state, layout.shardings(state)), put_batch(clips, layout.mesh))
    np.testing.assert_array_equal(state.params["camera_head"]["bias"], pixel_params["camera_head"]["bias"])
    assert (np.asarray(state.params["camera_head"]["kernel"]) != pixel_params["camera_head"]["kernel"]).all()
