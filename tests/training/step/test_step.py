"""The training step: the same on one device and on many, safe against non-finite numbers, traced once."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from parallel_runs import first_gradient

from logvggt_jax.training.config import LossConfig, OptimizerConfig, StageConfig
from logvggt_jax.training.parallel.sharding import check_batch_size, data_mesh, parameter_layout, put_batch, replicated
from logvggt_jax.training.step.optimizer import learning_rate_schedule, make_optimizer
from logvggt_jax.training.step.state import initial_state
from logvggt_jax.training.step.train_step import make_loss_terms, make_train_step

Clips = dict[str, np.ndarray]
STAGES = (StageConfig("only", 8, 5, 8, 1, 1, ((28, 42),)),)


def _gradients(model: Any, config: LossConfig, mesh: Mesh, params: Any, clips: Clips) -> tuple[Any, Any]:
    """What is logged, and the gradient."""
    _, metrics, found, _ = first_gradient(model, config, params, clips, mesh)
    return metrics, found


def test_gradient_on_many_devices_is_that_on_one(
    pixel_model: Any, loss_config: LossConfig, pixel_params: Any, clips: Clips
) -> None:
    one = _gradients(pixel_model, loss_config, data_mesh(1), pixel_params, clips)
    for devices in (2, 8):
        many = _gradients(pixel_model, loss_config, data_mesh(devices), pixel_params, clips)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6), many, one)
    assert all(np.abs(leaf).max() > 1e-3 for leaf in jax.tree.leaves(one[1]["camera_head"]))


def test_loss_is_the_mean_over_all_valid_pixels(
    pixel_model: Any, loss_config: LossConfig, pixel_params: Any, clips: Clips
) -> None:
    # The mean of the devices' own means would be another number: their shares of valid pixels differ.
    whole, _ = _gradients(pixel_model, loss_config, data_mesh(8), pixel_params, clips)
    alone = [
        _gradients(pixel_model, loss_config, data_mesh(1), pixel_params, {k: v[i : i + 1] for k, v in clips.items()})[0]
        for i in (0, 7)
    ]
    pair = {key: np.concatenate([value[:1], value[7:]]) for key, value in clips.items()}
    both, _ = _gradients(pixel_model, loss_config, data_mesh(2), pixel_params, pair)
    mean = np.mean([metrics["loss/depth_error"] for metrics in alone])
    assert abs(both["loss/depth_error"] - mean) > 1e-2 * mean and np.isfinite(whole["loss/total"])


def test_total_is_the_weighted_sum_of_its_terms(
    pixel_model: Any, loss_config: LossConfig, pixel_params: Any, clips: Clips
) -> None:
    config = dataclasses.replace(loss_config, camera_weight=5.0, depth_weight=2.0)
    metrics, _ = _gradients(pixel_model, config, data_mesh(1), pixel_params, clips)
    depth = metrics["loss/depth_error"] + metrics["loss/depth_gradient"] + metrics["loss/depth_confidence"]
    assert metrics["loss/total"] == pytest.approx(5.0 * metrics["loss/camera"] + 2.0 * depth, rel=1e-5)


def test_released_trainers_losses_are_averaged_over_devices_as_they_are(
    pixel_model: Any, loss_config: LossConfig, pixel_params: Any, clips: Clips
) -> None:
    """Its data parallelism averages what each device finds over its own pixels, quantiles among them."""
    config = dataclasses.replace(loss_config, name="vggt", quantile=0.98, camera_weight=5.0)
    halves = [{key: value[part] for key, value in clips.items()} for part in (slice(0, 4), slice(4, 8))]
    alone = [_gradients(pixel_model, config, data_mesh(1), pixel_params, half) for half in halves]
    metrics, gradients = _gradients(pixel_model, config, data_mesh(2), pixel_params, clips)
    assert {"loss/camera_rotation", "loss/depth_regression"} <= metrics.keys()
    for name in (name for name in metrics if name.startswith("loss/")):
        assert metrics[name] == pytest.approx((alone[0][0][name] + alone[1][0][name]) / 2, rel=1e-5), name
    jax.tree.map(
        lambda a, b, both: np.testing.assert_allclose(both, (a + b) / 2, rtol=2e-5, atol=1e-6),
        alone[0][1],
        alone[1][1],
        gradients,
    )


def test_steps_learn_and_are_traced_once(
    pixel_model: Any, loss_config: LossConfig, optimizer_config: OptimizerConfig, pixel_params: Any, clips: Clips
) -> None:
    mesh = data_mesh(4)
    layout = parameter_layout(pixel_params, mesh, shard=False)
    traces = 0
    terms = make_loss_terms(pixel_model, loss_config)

    def counted(params: Any, batch: Any) -> Any:
        nonlocal traces
        traces += 1
        return terms(params, batch)

    optimizer = make_optimizer(optimizer_config, pixel_params, frozen=("encoder/*",))
    step = make_train_step(counted, loss_config, optimizer, learning_rate_schedule(optimizer_config, STAGES), layout)
    state = jax.device_put(initial_state(jax.tree.map(jnp.array, pixel_params), optimizer), replicated(mesh))
    losses, kinds = [], jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), state)
    for _ in range(6):
        state, metrics, _ = step(state, put_batch(clips, mesh))
        losses.append(float(metrics["loss/total"]))
    assert traces == 1
    assert jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), state) == kinds
    assert losses[-1] < losses[0] and int(state.step) == 6
    np.testing.assert_array_equal(state.params["encoder"]["kernel"], pixel_params["encoder"]["kernel"])


@pytest.mark.parametrize("broken", ["loss", "gradient"])
def test_non_finite_updates_are_skipped_and_counted(
    pixel_model: Any,
    loss_config: LossConfig,
    optimizer_config: OptimizerConfig,
    pixel_params: Any,
    clips: Clips,
    broken: str,
) -> None:
    mesh = data_mesh(2)
    layout = parameter_layout(pixel_params, mesh, shard=False)
    terms = make_loss_terms(pixel_model, loss_config)

    def breakable(params: Any, batch: Any) -> Any:
        """Black pictures make the loss NaN, or leave it finite and make its gradient NaN."""
        means, figures, finite = terms(params, batch)
        light = jnp.where(batch["images"].astype(jnp.float32).sum() > 0, 1.0, 0.0)
        if broken == "loss":
            added = jnp.where(light > 0, 0.0, jnp.nan)
        else:
            added = jnp.sqrt(light * params["camera_head"]["bias"].sum() ** 2)
        camera = means["camera"]
        return {**means, "camera": camera._replace(numerator=camera.numerator + added)}, figures, finite

    optimizer = make_optimizer(optimizer_config, pixel_params, frozen=())
    schedule = learning_rate_schedule(optimizer_config, STAGES)
    step = make_train_step(breakable, loss_config, optimizer, schedule, layout)
    state = jax.device_put(initial_state(jax.tree.map(jnp.array, pixel_params), optimizer), replicated(mesh))
    good = put_batch(clips, mesh)
    bad = put_batch({**clips, "images": np.zeros_like(clips["images"])}, mesh)
    for _ in range(2):
        state, *_ = step(state, good)
    before = jax.device_get(state)
    for _ in range(3):
        state, metrics, _ = step(state, bad)
    after = jax.device_get(state)
    jax.tree.map(np.testing.assert_array_equal, (after.params, after.opt_state), (before.params, before.opt_state))
    assert float(metrics["skipped"]) == 3 and int(after.skipped_in_a_row) == 3
    state, metrics, _ = step(state, good)
    assert int(state.skipped_in_a_row) == 0 and float(metrics["longest_skip"]) == 3
    bias = np.asarray(state.params["camera_head"]["bias"])
    assert np.isfinite(bias).all()
    assert not np.array_equal(bias, before.params["camera_head"]["bias"])


def test_a_clip_whose_finite_predictions_overflow_its_loss_is_told_from_the_others(
    pixel_model: Any, loss_config: LossConfig, pixel_params: Any, clips: Clips
) -> None:
    class FarOff(type(pixel_model)):  # type: ignore[misc]
        """Sees black pictures very far away, and is very sure of it."""

        def apply(self, variables: Any, images: jax.Array, *given: Any, **options: Any) -> Any:
            predictions = super().apply(variables, images, *given, **options)
            black = (images.sum((1, 2, 3, 4)) == 0)[:, None, None, None]
            depth, confidence = (jnp.where(black, 1e30, x) for x in (predictions.depth, predictions.depth_confidence))
            return dataclasses.replace(predictions, depth=depth, depth_confidence=confidence)

    images = clips["images"].copy()
    images[2] = 0
    terms = jax.jit(make_loss_terms(FarOff(pixel_model.config), loss_config))
    means, _, finite = terms(pixel_params, {**clips, "images": images})
    assert not np.isfinite(means["depth_error"].numerator)
    assert finite.tolist() == [clip != 2 for clip in range(8)]


def test_batches_have_to_split_over_the_devices() -> None:
    with pytest.raises(ValueError, match="stage 'only': batch_size=8 does not split over 3 devices"):
        check_batch_size(STAGES[0], data_mesh(3))
