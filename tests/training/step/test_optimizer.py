"""Groups, clipping, weight decay and schedules."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax.training.config import OptimizerConfig, StageConfig
from logvggt_jax.training.step.optimizer import learning_rate_schedule, make_optimizer

PARAMS = {
    "encoder": {"kernel": jnp.ones((4, 4))},
    "aggregator": {"kernel": jnp.ones((4, 4)), "token": jnp.ones((1, 1, 4)), "bias": jnp.ones(4)},
    "depth_head": {"kernel": jnp.ones((4, 4))},
}


def _stages(*steps: int) -> tuple[StageConfig, ...]:
    return tuple(StageConfig(f"stage_{i}", n, 2, 2, 1, 1, ((28, 42),)) for i, n in enumerate(steps))


def test_frozen_modules_do_not_move_and_have_no_moments(optimizer_config: OptimizerConfig) -> None:
    optimizer = make_optimizer(optimizer_config, PARAMS, frozen=("encoder/*",))
    state = optimizer.init(PARAMS)
    directions, _ = optimizer.update(PARAMS, state, PARAMS)
    assert not np.asarray(directions["encoder"]["kernel"]).any()
    assert np.asarray(directions["depth_head"]["kernel"]).all()
    moments = [leaf for leaf in jax.tree.leaves(state) if leaf.ndim]
    assert len(moments) == 2 * 4, "two moments for each leaf that is trained"


def test_an_exploding_module_is_clipped_alone(optimizer_config: OptimizerConfig) -> None:
    # Adam forgets a constant factor, so the second of two gradients has to be the exploding one.
    optimizer = make_optimizer(dataclasses.replace(optimizer_config, weight_decay=0.0), PARAMS, frozen=())
    small = jax.tree.map(lambda x: 0.01 * x, PARAMS)
    large = {**small, "depth_head": {"kernel": 1e6 * PARAMS["depth_head"]["kernel"]}}
    found = []
    for second in (small, large):
        state = optimizer.init(PARAMS)
        _, state = optimizer.update(small, state, PARAMS)
        found.append(optimizer.update(second, state, PARAMS)[0])
    np.testing.assert_array_equal(found[0]["aggregator"]["kernel"], found[1]["aggregator"]["kernel"])
    clipped = {**small, "depth_head": {"kernel": jnp.full((4, 4), 0.25)}}
    state = optimizer.update(small, optimizer.init(PARAMS), PARAMS)[1]
    expected = optimizer.update(clipped, state, PARAMS)[0]
    np.testing.assert_allclose(found[1]["depth_head"]["kernel"], expected["depth_head"]["kernel"], rtol=1e-5)


def test_muon_turns_the_matrices_of_linear_layers_and_leaves_the_rest_to_adam(
    optimizer_config: OptimizerConfig,
) -> None:
    generator = np.random.default_rng(0)
    shapes = {"linear": (12, 8), "stack": (3, 8, 12), "conv": (3, 3, 4, 4)}
    params: Any = {"head": {name: {"kernel": jnp.ones(shape), "bias": jnp.ones(4)} for name, shape in shapes.items()}}
    gradients = jax.tree.map(lambda x: jnp.asarray(generator.standard_normal(x.shape), jnp.float32), params)
    plain = dataclasses.replace(optimizer_config, weight_decay=0.0)

    def second_direction(config: OptimizerConfig) -> Any:
        optimizer = make_optimizer(config, params, frozen=())
        state = optimizer.update(gradients, optimizer.init(params), params)[1]
        return optimizer.update(gradients, state, params)[0]["head"]

    found = second_direction(dataclasses.replace(plain, algorithm="muon"))
    by_adam = second_direction(plain)
    for name in ("linear", "stack"):
        moved, given = (
            np.asarray(tree[name]["kernel"]).reshape(-1, *shapes[name][-2:]) for tree in (found, gradients["head"])
        )
        for matrix, gradient in zip(moved, given, strict=True):
            # All singular values alike, about 0.2 for each value of the matrix, in the directions of the gradient's.
            u, _, v = np.linalg.svd(gradient, full_matrices=False)
            along = np.diag(u.T @ matrix @ v.T)
            assert np.linalg.norm(matrix - u * along @ v) < 1e-3 * np.linalg.norm(matrix)
            assert along.min() > 0.4 * along.max()
            assert np.sqrt((matrix**2).mean()) == pytest.approx(0.2, rel=0.25)
    assert not np.allclose(found["linear"]["kernel"], by_adam["linear"]["kernel"], atol=0.05)
    np.testing.assert_array_equal(found["conv"]["kernel"], by_adam["conv"]["kernel"])
    for name in shapes:
        np.testing.assert_array_equal(found[name]["bias"], by_adam[name]["bias"])


@pytest.mark.parametrize("decay_all", [False, True])
def test_weight_decay_falls_on_kernels_alone(
    optimizer_config: OptimizerConfig, small_variables: dict[str, Any], decay_all: bool
) -> None:
    """On the real model's parameters by name and rank: no token, no position embedding, no gain, no bias."""
    # Of equal sizes, as every shape would compile anew.
    params = jax.tree.map(lambda x: jnp.ones((2,) * x.ndim), small_variables["params"])
    optimizer = make_optimizer(dataclasses.replace(optimizer_config, decay_all=decay_all), params, frozen=())
    zeros = jax.tree.map(jnp.zeros_like, params)
    directions, _ = optimizer.update(zeros, optimizer.init(params), params)
    decayed, spared = set(), set()
    for path, direction in jax.tree_util.tree_leaves_with_path(directions):
        (decayed if np.asarray(direction).any() else spared).add(path[-1].key)
    if decay_all:
        assert not spared
    else:
        assert decayed == {"kernel"}
        assert {"camera_token", "register_token", "pos_embed", "empty_pose_tokens", "gamma", "scale", "bias"} <= spared


def test_cosine_warms_up_peaks_and_ends_low(optimizer_config: OptimizerConfig) -> None:
    schedule = learning_rate_schedule(optimizer_config, _stages(60, 40))
    rates = np.array([float(schedule(step)) for step in range(101)])
    assert rates[0] == 0.0 and rates.argmax() == 25 and rates[25] == pytest.approx(1e-2)
    assert rates[100] == pytest.approx(1e-4) and (np.diff(rates[25:]) < 0).all()


def test_linear_tail_stays_until_the_last_quarter(optimizer_config: OptimizerConfig) -> None:
    config = dataclasses.replace(optimizer_config, schedule="linear_tail", warmup_fraction=0.1)
    schedule = learning_rate_schedule(config, _stages(100))
    rates = np.array([float(schedule(step)) for step in range(101)])
    np.testing.assert_allclose(rates[10:76], 1e-2, rtol=1e-6)
    assert rates[5] == pytest.approx(5e-3) and rates[100] == pytest.approx(1e-4)
    np.testing.assert_allclose(np.diff(rates[75:]), (1e-4 - 1e-2) / 25, rtol=1e-3)


def test_each_stage_can_have_its_own_schedule(optimizer_config: OptimizerConfig) -> None:
    config = dataclasses.replace(optimizer_config, restart_each_stage=True)
    schedule = learning_rate_schedule(config, _stages(40, 80))
    assert float(schedule(10)) == pytest.approx(1e-2) and float(schedule(40)) == 0.0
    assert float(schedule(60)) == pytest.approx(1e-2)
