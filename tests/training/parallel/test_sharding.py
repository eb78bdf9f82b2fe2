"""Parameters in parts and clips one after the other: the numbers of one device with everything, and less memory."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P
from parallel_runs import (
    LayeredModel,
    Outcome,
    exchanged,
    first_gradient,
    layers_in_parts,
    steps,
    steps_of_processes,
)

from logvggt_jax import LogVGGT, ModelConfig, Predictions
from logvggt_jax.model.parameters import stack_layers
from logvggt_jax.training import loop
from logvggt_jax.training.checkpoints.checkpoint_files import Position, StoredCheckpoint
from logvggt_jax.training.config import LossConfig, TrainConfig
from logvggt_jax.training.loop import train
from logvggt_jax.training.parallel.sharding import (
    Layout,
    check_batch_size,
    data_mesh,
    parameter_layout,
    put_batch,
    use_cpu_cores,
)
from logvggt_jax.training.parallel.watchdog import Watchdog
from logvggt_jax.training.step.costs import collectives
from logvggt_jax.training.step.freezing import ENCODER, frozen_leaves
from logvggt_jax.training.step.program import abstract_parameters, make_program
from logvggt_jax.training.step.state import TrainState

Clips = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def sixteen(clips: Clips) -> Clips:
    """Sixteen clips with uneven masks."""
    return {name: np.concatenate([value, value[::-1]]) for name, value in clips.items()}


@pytest.fixture(scope="module")
def alone(layered: Any, loss_config: LossConfig, layered_params: Any, sixteen: Clips) -> Any:
    return first_gradient(layered, loss_config, layered_params, sixteen, data_mesh(1))


@pytest.mark.parametrize(
    ("devices", "shard", "accumulate"),
    [
        (4, True, 2),
        (4, False, 4),
        (16, True, 1),
        # Each of these leaves out something of those above.
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in ((1, False, 4), (4, False, 1), (4, True, 1), (16, False, 1))
        ),
    ],
)
def test_first_gradient_is_that_of_one_device(
    devices: int,
    shard: bool,
    accumulate: int,
    layered: Any,
    loss_config: LossConfig,
    layered_params: Any,
    sixteen: Clips,
    alone: Any,
) -> None:
    mesh = data_mesh(devices)
    found = first_gradient(layered, loss_config, layered_params, sixteen, mesh, shard=shard, accumulate=accumulate)
    _agree(found, alone, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("devices", "shard", "accumulate"), [(4, True, 2), (16, True, 1)])
def test_first_gradient_of_the_real_model_is_that_of_one_device(
    devices: int, shard: bool, accumulate: int, small_config: ModelConfig, loss_config: LossConfig, sixteen: Clips
) -> None:
    # All of it trained, with layers that run as loops in encoder and aggregator.
    encoder = dataclasses.replace(small_config.encoder, frozen=False, depth=2)
    aggregator = dataclasses.replace(small_config.aggregator, depth=6, key_layers=(0, 1, 2, 5))
    model = LogVGGT(dataclasses.replace(small_config, encoder=encoder, aggregator=aggregator))
    variables = model.init(jax.random.key(0), np.zeros((1, 1, 28, 42, 3), np.float32))
    params = jax.device_get(stack_layers(variables["params"]))
    generator = np.random.default_rng(0)
    # No gate is zero.
    params = jax.tree.map(lambda x: x + 0.1 * generator.standard_normal(x.shape).astype(np.float32), params)
    short = {name: value[:, :3] for name, value in sixteen.items()}
    one = first_gradient(model, loss_config, params, short, data_mesh(1))
    found = first_gradient(model, loss_config, params, short, data_mesh(devices), shard=shard, accumulate=accumulate)
    _agree(found, one, rel=1e-5)


def _gentle(config: TrainConfig, **changes: Any) -> TrainConfig:
    """A rate at which differences of rounding stay what they are, all modules trained, and no clipping."""
    encoder = dataclasses.replace(config.model.encoder, frozen=False)
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, encoder=encoder),
        optimizer=dataclasses.replace(config.optimizer, learning_rate=1e-4, clip_norm=1e9),
        **changes,
    )


def _same_gradient(found: Outcome, expected: Outcome) -> None:
    """Module by module."""
    for module, gradients in expected.gradient.items():
        difference = _norm(jax.tree.map(np.subtract, found.gradient[module], gradients))
        assert difference <= 1e-5 * _norm(gradients), module


def _same_run(found: Outcome, expected: Outcome) -> None:
    """The first gradient and the losses of all steps."""
    _same_gradient(found, expected)
    assert len(found.losses) == 20 and found.losses == pytest.approx(expected.losses, rel=1e-3)


@pytest.mark.slow
def test_twenty_steps_on_sixteen_devices_and_in_two_processes_are_those_of_one_device(
    run_config: TrainConfig, layered: LayeredModel, layered_params: Any, sixteen: Clips, tmp_path: Path
) -> None:
    alone = steps(layered, _gentle(run_config), layered_params, sixteen, data_mesh(1), 20)
    assert alone.losses[-1] < alone.losses[0] - 0.01, "it learns"
    parts = _gentle(run_config, shard_parameters=True)
    _same_run(steps(layered, parts, layered_params, sixteen, data_mesh(16), 20), alone)
    both = dataclasses.replace(parts, accumulate=2)
    _same_run(*steps_of_processes([both], layered_params, sixteen, 20, tmp_path, layered=True), alone)


def test_first_gradient_of_two_processes_is_that_of_one_device(
    run_config: TrainConfig, layered: LayeredModel, layered_params: Any, sixteen: Clips, tmp_path: Path
) -> None:
    config = _gentle(run_config)
    alone = steps(layered, config, layered_params, sixteen, data_mesh(1), 1)
    configs = [
        dataclasses.replace(config, shard_parameters=shard, accumulate=accumulate)
        for shard in (False, True)
        for accumulate in (1, 2)
    ]
    for found in steps_of_processes(configs, layered_params, sixteen, 1, tmp_path, layered=True):
        _same_gradient(found, alone)


@dataclasses.dataclass(frozen=True)
class OnePart:
    """LoG-VGGT of which one part alone decides the loss, so that no other's gradient is compiled: its poses, its depth,
    or its camera and register tokens, off which poses are read then. What the part needs runs as it is."""

    config: ModelConfig
    part: str

    def apply(self, *args: Any, **options: Any) -> Predictions:
        found: Predictions = LogVGGT(self.config).apply(*args, **options)
        if self.part != "depth":
            found = dataclasses.replace(
                found, depth=jnp.ones_like(found.depth), depth_confidence=jnp.full_like(found.depth, 2.0)
            )
        if self.part != "poses":
            tokens = found.camera_tokens + found.register_tokens.sum(2)
            poses = jnp.zeros_like(tokens[..., :9]).at[..., 6:].set(1.0)
            if self.part == "tokens":
                poses += 0.1 * jnp.tanh(tokens[..., :9])
            found = dataclasses.replace(found, pose_encodings=poses[:, :, None])
        return found


# The quick tests take the gradient of the real model in three parts, as most of a test's time is its compilation: what
# has none meanwhile.
GRADIENTS: dict[str, tuple[str, ...]] = {
    "tokens": ("camera_head/*", "depth_head/*", "gccr/*"),
    "poses": ("aggregator/*", "depth_head/*"),
    "depth": ("aggregator/*", "camera_head/*", "gccr/*"),
}


def _real_gradient(config: TrainConfig, clips: Clips, devices: int, part: str) -> Any:
    """That of two clips for one part of the model, whose parameters lie in parts; no gate is zero."""
    two = {name: value[3:5, :2] for name, value in clips.items() if name != "frame_mask"}
    params = _real_parameters(config.model)
    model, frozen = OnePart(config.model, part), (ENCODER, *GRADIENTS[part])
    return first_gradient(model, config.loss, params, two, data_mesh(devices), shard=True, frozen=frozen)


@pytest.fixture(scope="module")
def real_gradients(run_config: TrainConfig, clips: Clips) -> Callable[[str], Any]:
    """Those of one device."""
    return functools.cache(lambda part: _real_gradient(run_config, clips, 1, part))


@pytest.mark.parametrize("part", GRADIENTS)
def test_the_gradient_reaches_every_parameter_of_the_real_model_but_the_encoders(
    part: str, run_config: TrainConfig, real_gradients: Callable[[str], Any]
) -> None:
    total, _, gradients, norm = real_gradients(part)
    assert np.isfinite([total, norm]).all()
    still = jax.tree.map(lambda x: not x.any(), gradients)
    assert still == frozen_leaves(abstract_parameters(run_config.model), (ENCODER, *GRADIENTS[part]))


@pytest.mark.parametrize("part", GRADIENTS)
def test_the_gradient_of_the_real_model_in_parts_is_that_of_one_device(
    part: str, run_config: TrainConfig, clips: Clips, real_gradients: Callable[[str], Any]
) -> None:
    _agree(_real_gradient(run_config, clips, 2, part), real_gradients(part), rel=1e-5)


# What a quick test of the real model leaves as it is: all runs and is gathered, while GCCR, camera head and the depth
# head's last convolutions are trained. Most of a compilation is the gradient through the layers, which slow tests have.
FROZEN = ("aggregator/*", "depth_head/[!o]*")


def _one_real_step(config: TrainConfig, clips: Clips, *, shard: bool) -> Outcome:
    """A step of LoG-VGGT on one device, or with parameters in parts on two; no gate is zero."""
    optimizer = dataclasses.replace(config.optimizer, frozen=FROZEN, warmup_fraction=0.0, weight_decay=0.0)
    config = dataclasses.replace(config, optimizer=optimizer, shard_parameters=shard)
    two = {name: value[3:5, :2] for name, value in clips.items() if name != "frame_mask"}
    return steps(LogVGGT(config.model), config, _real_parameters(config.model), two, data_mesh(2 if shard else 1), 1)


def _real_parameters(config: ModelConfig) -> Any:
    generator = np.random.default_rng(0)
    return jax.tree_util.tree_map_with_path(
        lambda path, x: np.float32(path[-1].key == "scale") + 0.1 * generator.standard_normal(x.shape, np.float32),
        abstract_parameters(config),
    )


@pytest.fixture(scope="module")
def real_step(run_config: TrainConfig, clips: Clips) -> Outcome:
    """That of whole parameters on one device."""
    return _one_real_step(run_config, clips, shard=False)


def test_a_step_of_the_real_model_moves_what_is_trained_and_nothing_else(
    run_config: TrainConfig, real_step: Outcome
) -> None:
    assert np.isfinite(real_step.losses).all()
    _moves_what_is_trained(real_step, _real_parameters(run_config.model))


def _moves_what_is_trained(found: Outcome, before: Any) -> None:
    still = jax.tree.map(lambda old, new: bool((old == new).all()), before, found.params)
    assert still == frozen_leaves(before, (ENCODER, *FROZEN))


def test_a_step_of_the_real_model_in_parts_is_that_of_one_device(
    run_config: TrainConfig, clips: Clips, real_step: Outcome
) -> None:
    in_parts = _one_real_step(run_config, clips, shard=True)
    _same_gradient(in_parts, real_step)
    assert in_parts.losses == pytest.approx(real_step.losses, rel=1e-5)
    # What is put together is one parameter, of a stack that of one layer.
    params = abstract_parameters(run_config.model)
    layers, parts = layers_in_parts(params, parameter_layout(params, data_mesh(2), shard=True))
    gathered, scattered = (exchanged(in_parts.program, kind) for kind in ("all-gather", "reduce-scatter"))
    assert gathered <= layers and scattered <= parts
    assert (32, 128) in gathered and (32, 64) in scattered, "a stack's first product, and one of GCCR"
    # Adam's first update, by its own gradient: beside one device's, one near zero may have the other sign.
    before, rate = _real_parameters(run_config.model), run_config.optimizer.learning_rate
    _moves_what_is_trained(in_parts, before)
    for path, gradient in jax.tree_util.tree_leaves_with_path(in_parts.gradient):
        old, new = (functools.reduce(lambda tree, at: tree[at.key], path, tree) for tree in (before, in_parts.params))
        np.testing.assert_allclose(new, old - rate * gradient / (np.abs(gradient) + 1e-8), rtol=1e-4, atol=2e-5)


@pytest.mark.slow
def test_twenty_steps_of_the_real_model_are_the_same_on_all_devices_and_in_two_processes(
    run_config: TrainConfig, sixteen: Clips, tmp_path: Path
) -> None:
    config = _gentle(run_config)
    model = LogVGGT(config.model)
    variables = model.init(jax.random.key(0), np.zeros((1, 1, 28, 42, 3), np.float32))
    generator = np.random.default_rng(0)
    params = jax.tree.map(
        lambda x: x + 0.1 * generator.standard_normal(x.shape).astype(np.float32),
        jax.device_get(stack_layers(variables["params"])),
    )
    short = {name: value[:, :3] for name, value in sixteen.items() if name != "frame_mask"}
    alone = steps(model, config, params, short, data_mesh(1), 20)
    for devices, shard, accumulate in ((1, False, 4), (4, False, 1), (4, True, 2), (16, False, 1), (16, True, 1)):
        changed = dataclasses.replace(config, shard_parameters=shard, accumulate=accumulate)
        _same_run(steps(model, changed, params, short, data_mesh(devices), 20), alone)
    both = [
        dataclasses.replace(config, shard_parameters=shard, accumulate=accumulate)
        for shard, accumulate in ((False, 1), (True, 2))
    ]
    for found in steps_of_processes(both, params, short, 20, tmp_path, layered=False):
        _same_run(found, alone)


def test_a_step_gathers_one_layer_at_a_time_and_scatters_its_gradient(
    run_config: TrainConfig, layered: LayeredModel, layered_params: Any, clips: Clips
) -> None:
    sharded, mesh = dataclasses.replace(run_config, shard_parameters=True), data_mesh(4)
    layers, parts = layers_in_parts(layered_params, parameter_layout(layered_params, mesh, shard=True))
    program = steps(layered, sharded, layered_params, clips, mesh, 1).program
    found = collectives(program)
    assert layers == {(3, 16), (16, 16)} and exchanged(program, "all-gather") == layers
    assert exchanged(program, "reduce-scatter") == parts
    # Forward and again backward, where what was put together is not kept, in each of four rounds of a loop.
    embed, layer = 4 * 3 * 16, 4 * 16 * 16
    assert found["all-gather"] == (1 + 2 * 4, embed + 2 * 4 * layer)
    assert found["reduce-scatter"] == (1 + 4, (embed + 4 * layer) // 4)
    # Sums over the devices are of what is whole on each, besides some numbers for the log: of no gradient twice.
    trained = {name: layered_params[name] for name in ("camera_head", "depth_head")}
    whole = sum(x.nbytes for x in jax.tree.leaves((trained, layered_params["aggregator"]["frame_blocks"]["bias"])))
    assert whole <= found["all-reduce"][1] < whole + embed
    assert found.keys() == {"all-gather", "reduce-scatter", "all-reduce"}


def _agree(found: Any, expected: Any, *, rel: float) -> None:
    """Objective, what is logged, and the gradient of every module and of all."""
    assert found[0] == pytest.approx(expected[0], rel=rel)
    for name, value in expected[1].items():
        assert found[1][name] == pytest.approx(value, rel=1e-4, abs=1e-5), name
    for module, gradients in expected[2].items():
        difference = _norm(jax.tree.map(np.subtract, found[2][module], gradients))
        assert difference <= rel * _norm(gradients), module
    assert found[3] == pytest.approx(_norm(expected[2]), rel=rel)


def _norm(tree: Any) -> float:
    return float(np.sqrt(sum((leaf.astype(np.float64) ** 2).sum() for leaf in jax.tree.leaves(tree))))


def test_matrices_are_split_along_no_axis_of_layers_and_vectors_stay_whole(layered_params: Any) -> None:
    specs = parameter_layout(layered_params, data_mesh(4), shard=True).specs(layered_params)
    assert specs["aggregator"] == {
        "embed": {"kernel": P(None, "data")},
        "frame_blocks": {"kernel": P(None, "data", None), "bias": P()},
    }
    assert specs["camera_head"] == {"kernel": P(), "bias": P()}, "four does not divide 3 x 9"
    assert not parameter_layout(layered_params, data_mesh(4), shard=False).axes


def test_the_state_lies_in_its_place_from_the_start(run_config: TrainConfig, layered: Any, layered_params: Any) -> None:
    config = dataclasses.replace(run_config, shard_parameters=True, average=0.9)
    shapes = jax.eval_shape(lambda: layered_params)
    program = make_program(layered, config, shapes, data_mesh(4))
    state = program.initial_state(layered_params)
    kernel = state.params["aggregator"]["frame_blocks"]["kernel"]
    assert kernel.addressable_shards[0].data.size == kernel.size // 4
    like = [leaf for leaf in jax.tree.leaves(state) if leaf.shape == kernel.shape]
    assert len(like) == 4, "the parameter, two moments, the average"
    assert {leaf.sharding for leaf in like} == {kernel.sharding}
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(state.params), layered_params)
    for leaf, expected in zip(*map(jax.tree.leaves, (state, program.abstract_state)), strict=True):
        assert (leaf.shape, leaf.dtype, leaf.sharding.spec) == (expected.shape, expected.dtype, expected.sharding.spec)
    # No two of them share memory, which a step is given to overwrite.
    places = [
        shard.data.unsafe_buffer_pointer() for leaf in jax.tree.leaves(state) for shard in leaf.addressable_shards
    ]
    assert len(set(places)) == len(places)


@pytest.mark.parametrize("shard", [True, False])
def test_no_device_ever_holds_a_second_copy_when_a_run_starts_or_goes_on(
    shard: bool,
    run_config: TrainConfig,
    layered: LayeredModel,
    layered_params: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Shapes, then places, then values: each goes to where it stays, from the host or from the disk."""
    monkeypatch.setattr(loop, "LogVGGT", lambda _: layered)
    monkeypatch.setattr(loop, "abstract_parameters", lambda _: jax.eval_shape(lambda: layered_params))
    monkeypatch.setattr("logvggt_jax.training.checkpoints.run_models.save_model", lambda *_: None)
    config, mesh = dataclasses.replace(run_config, shard_parameters=shard, average=0.5), data_mesh(4)
    # Held until the end, so that none of the new ones gets the number of one that is gone.
    earlier = jax.live_arrays()
    before, held = {id(x) for x in earlier}, []

    def look(*_: Any, **__: Any) -> None:
        # An array and its parts are the same memory.
        places = {
            (part.device, part.data.unsafe_buffer_pointer()): part.data.nbytes
            for array in (x for x in jax.live_arrays() if id(x) not in before)
            for part in array.addressable_shards
        }
        held.append(max(sum(size for (at, _), size in places.items() if at == device) for device in mesh.devices.flat))

    def initial(*_: Any, **__: Any) -> Any:
        look()
        return layered_params

    monkeypatch.setattr(loop, "initial_parameters", initial)
    put, read, verified = Layout.put, StoredCheckpoint.read, StoredCheckpoint.verified
    monkeypatch.setattr(Layout, "put", lambda *given: (look(), put(*given), look())[1])
    monkeypatch.setattr(StoredCheckpoint, "read", lambda *given: (look(), read(*given), look())[1])
    monkeypatch.setattr(StoredCheckpoint, "verified", lambda *given: (look(), verified(*given), look())[1])
    for step in (0, 1):
        program = make_program(layered, config, jax.eval_shape(lambda: layered_params), mesh)
        run = loop._Run(config, tmp_path, program, Watchdog(0), (), trained_on=())
        with run.checkpoints as checkpoints:
            run.start(None)
            state = run.state
            look()
            size = max(sum(leaf.addressable_shards[i].data.nbytes for leaf in jax.tree.leaves(state)) for i in range(4))
            assert held[0] == 0, "shapes alone until then"
            assert max(held) == held[-1] == size
            if step == 0:
                checkpoints.save(state._replace(step=state.step + 1), Position(0, {}))
                checkpoints.wait()
        del run, state
        before, held[:] = {id(x) for x in jax.live_arrays()}, []


Steps = list[tuple[TrainState, dict[str, float], np.ndarray]]


def _three_steps(config: TrainConfig, model: Any, params: Any, clips: Clips, devices: int) -> Steps:
    """What three steps that keep an average return, on the host."""
    mesh, averaging = data_mesh(devices), dataclasses.replace(config, average=0.75)
    program = make_program(model, averaging, jax.eval_shape(lambda: params), mesh)
    state, batch = program.initial_state(params), put_batch(clips, mesh)
    compiled, found = program.step.lower(state, batch).compile(), []
    for _ in range(3):
        returned = compiled(state, batch)
        state = returned[0]
        found.append(jax.device_get(returned))
    return found


@pytest.fixture(scope="module")
def steps_alone(run_config: TrainConfig, layered: Any, layered_params: Any, sixteen: Clips) -> Steps:
    """Those of one device with whole parameters."""
    return _three_steps(run_config, layered, layered_params, sixteen, 1)


def test_steps_in_parts_are_those_of_whole_parameters(
    run_config: TrainConfig, layered: Any, layered_params: Any, sixteen: Clips, steps_alone: Steps
) -> None:
    split = dataclasses.replace(run_config, shard_parameters=True, accumulate=2)
    steps_in_parts = _three_steps(split, layered, layered_params, sixteen, 4)
    for _, metrics, finite in (steps_alone[-1], steps_in_parts[-1]):
        assert finite.shape == (16,) and finite.all()
        # Clipping by module has to know the whole gradient.
        assert float(metrics["gradient_norm/aggregator"]) > run_config.optimizer.clip_norm / 100
    one, many = steps_alone[-1][0], steps_in_parts[-1][0]
    for name in ("params", "average"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-5), getattr(one, name), getattr(many, name)
        )


def test_the_average_follows_the_parameters(layered_params: Any, steps_alone: Steps) -> None:
    state = steps_alone[-1][0]
    assert set(state.average) == set(layered_params) - {"encoder"}, "what is frozen is its own average"
    expected = {name: tree for name, tree in layered_params.items() if name != "encoder"}
    for after, *_ in steps_alone:
        expected = jax.tree.map(
            lambda a, p: 0.75 * a + 0.25 * p, expected, {name: after.params[name] for name in expected}
        )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), state.average, expected)
    moved = np.abs(state.averaged["camera_head"]["bias"] - state.params["camera_head"]["bias"]).max()
    assert moved > 1e-4


def test_a_sharded_run_is_saved_on_sixteen_devices_and_goes_on_with_eight(
    run_config: TrainConfig,
    layered: Any,
    layered_params: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loop, "LogVGGT", lambda _: layered)
    monkeypatch.setattr(loop, "initial_parameters", lambda *_, **__: layered_params)
    monkeypatch.setattr(loop, "abstract_parameters", lambda _: jax.eval_shape(lambda: layered_params))
    monkeypatch.setattr("logvggt_jax.training.checkpoints.run_models.save_model", lambda *_: None)
    stage = dataclasses.replace(run_config.stages[0], batch_size=16, steps=3)
    config = dataclasses.replace(run_config, stages=(stage,), average=0.5)
    sharded = dataclasses.replace(config, shard_parameters=True)
    straight = train(config, tmp_path / "straight", mesh=data_mesh(1))
    saved = train(dataclasses.replace(sharded, max_minutes=1e-9), tmp_path / "run", mesh=data_mesh(16))
    assert int(saved.step) == 1
    ended = train(dataclasses.replace(sharded, accumulate=2), tmp_path / "run", mesh=data_mesh(8))
    assert int(ended.step) == 3
    for name in ("params", "average"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4),
            *(jax.device_get(getattr(state, name)) for state in (ended, straight)),
        )


def test_batches_have_to_split_into_the_parts(run_config: TrainConfig) -> None:
    stage = dataclasses.replace(run_config.stages[0], batch_size=8)
    check_batch_size(stage, data_mesh(4), accumulate=2)
    with pytest.raises(ValueError, match=r"over 4 devices in accumulate=4 parts each; use a multiple of 16"):
        check_batch_size(stage, data_mesh(4), accumulate=4)


@pytest.mark.parametrize(
    ("clips", "accumulate", "processes", "devices"), [(12, 1, 1, 6), (12, 4, 1, 3), (12, 2, 2, 3), (4, 4, 1, 1)]
)
def test_as_many_cores_become_devices_as_the_parts_of_a_batch_split_over(
    clips: int,
    accumulate: int,
    processes: int,
    devices: int,
    run_config: TrainConfig,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: dict[str, int] = {}
    monkeypatch.setattr(jax.config, "update", given.__setitem__)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    stages = tuple(dataclasses.replace(stage, batch_size=clips) for stage in run_config.stages)
    use_cpu_cores(dataclasses.replace(run_config, stages=stages, accumulate=accumulate), num_processes=processes)
    assert given == {"jax_num_cpu_devices": devices}
    for stage in stages:
        check_batch_size(stage, data_mesh(devices * processes), accumulate=accumulate)
