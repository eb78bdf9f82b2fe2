"""The model as a whole: gradients, precision, heads, its place in other people's code."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pieces import in_pieces

from logvggt_jax import DPTConfig, LogVGGT, ModelConfig
from logvggt_jax.model.dpt_head import point_activation
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.parameters import in_compute_type, run, stack_layers, unstack_layers
from logvggt_jax.model.windows import Windows
from logvggt_jax.operations import count_flops

FRAMES = 6


def video(num_frames: int = FRAMES, batch: int = 1) -> np.ndarray:
    return np.random.default_rng(0).random((batch, num_frames, 28, 42, 3), dtype=np.float32)


@functools.lru_cache
def applied(config: ModelConfig):
    """Compiled once for all tests of one model."""
    return jax.jit(LogVGGT(config).apply)


@functools.partial(in_pieces, static=2)
def streamed_gradient(model: LogVGGT, loss, variables, images: np.ndarray):
    """Gradients by parameters and images of `loss` of the depth and poses of a stream, layer by layer compiled once."""
    overlap, stride = model.config.windows.size - model.config.windows.stride, model.config.windows.stride

    def of_stream(variables, images):
        state, outs = model.start(variables, images[:, :overlap]), []
        for first in range(overlap, images.shape[1], stride):
            state, out = model.step(variables, state, images[:, first : first + stride])
            outs.append(out)
        outs.append(model.finish(variables, state))
        out = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *outs)
        poses = model.refine(variables, out.camera_tokens, out.register_tokens, out.frame_mask, out.frame_mask)
        return loss(out, poses)

    return jax.grad(of_stream, argnums=(0, 1))(variables, images)


def gradient(config: ModelConfig, remat: bool):
    """Gradient by parameters of a loss of poses and depths."""
    model = LogVGGT(config)

    def loss(variables, images):
        out = model.apply(variables, images, remat=remat)
        return jnp.sin(out.pose_encodings).sum() + (jnp.log(out.depth) + jnp.log(out.depth_confidence)).sum()

    return jax.jit(jax.grad(loss))


def norms(tree) -> dict[str, float]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): float(np.linalg.norm(leaf)) for path, leaf in leaves}


def assert_only_the_encoder_is_silent(grads):
    for name, norm in norms(grads["params"]).items():
        assert np.isfinite(norm)
        assert (norm == 0) == name.startswith("['encoder']"), name


def thawed(config: ModelConfig) -> ModelConfig:
    return dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, frozen=False))


@pytest.mark.slow
def test_a_thawed_encoder_is_trained_and_rematerialisation_changes_no_gradient(small_config, small_variables):
    plain = gradient(small_config, False)(small_variables, video())
    assert_only_the_encoder_is_silent(plain)
    plain = plain["params"]
    again = gradient(thawed(small_config), True)(small_variables, video())["params"]
    silent = {name for name, norm in norms(again).items() if norm == 0}
    assert silent == {"['encoder']['mask_token']"}
    for part in set(plain) - {"encoder"}:
        # Some gradients are zero but for rounding (keys' biases, say): the part's largest sets the scale.
        scale = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(plain[part]))
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5 * scale), plain[part], again[part]
        )


@pytest.mark.slow
def test_training_runs_a_frozen_encoder_once_a_frame(small_config):
    """A deeper encoder makes the gradient dearer by its forward pass alone, rematerialisation or not."""

    def operations(depth: int) -> tuple[float, float]:
        encoder = dataclasses.replace(small_config.encoder, depth=depth)
        windows = Windows(dataclasses.replace(small_config, encoder=encoder), remat=True)
        variables = variable_shapes(windows.config)

        def encode(params, images):
            return run(windows.encoder, params, images)

        def loss(variables, images):
            return jnp.log(windows.scan(stack_layers(variables), images).depth).sum()

        forward = count_flops(encode, variables["params"]["encoder"], video()[0])
        return forward, count_flops(jax.grad(loss), variables, video())

    forward, gradient = (deeper - shallow for deeper, shallow in zip(operations(2), operations(1), strict=True))
    assert forward > 0
    assert gradient == pytest.approx(forward, rel=1e-3)


@pytest.mark.parametrize(
    ("key_layers", "cross_window"), [((0, 1, 3, 4), True), ((0, 1, 3, 5), True), ((0, 1, 3, 4), False)]
)
def test_layers_as_a_loop_are_the_layers_one_by_one(small_config, small_variables, key_layers, cross_window):
    """The encoder's; the aggregator's, of which some read the cache, the last one or not, or none; the trunk's."""
    sizes = dataclasses.replace(small_config.aggregator, depth=6, key_layers=key_layers)
    encoder = dataclasses.replace(small_config.encoder, depth=2)
    head = dataclasses.replace(small_config.camera_head, depth=3)
    windows = dataclasses.replace(small_config.windows, cross_window=cross_window)
    model = LogVGGT(
        dataclasses.replace(small_config, encoder=encoder, aggregator=sizes, camera_head=head, windows=windows)
    )

    def deeper(part: str, family: str, depth: int) -> None:
        first = sum(name.startswith(family) and name[len(family) :].isdigit() for name in params[part])
        for layer in range(first, depth):
            like = params[part][f"{family}{layer % first}"]
            params[part][f"{family}{layer}"] = jax.tree.map(lambda x: x * 1.1, like)

    params = {part: dict(small_variables["params"][part]) for part in ("encoder", "aggregator", "camera_head")}
    deeper("encoder", "block_", 2)
    deeper("aggregator", "frame_block_", 6)
    deeper("aggregator", "global_block_", 6)
    deeper("camera_head", "trunk_", 3)
    variables = {"params": params}
    stacks = jax.jit(stack_layers)(variables)
    jax.tree.map(np.testing.assert_array_equal, unstack_layers(jax.device_get(stacks), model.config), variables)
    assert stack_layers(stacks)["params"].keys() == stacks["params"].keys()
    on_host = stack_layers(jax.device_get(variables))
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(on_host)), "no device is asked for room"
    jax.tree.map(np.testing.assert_array_equal, on_host, stacks)

    generator, shapes = np.random.default_rng(0), jax.eval_shape(model.start, variables, video(2))
    # After a window, which has left a cache.
    state = jax.tree.map(
        lambda x: np.ones(x.shape, x.dtype) if x.dtype != jnp.float32 else generator.standard_normal(x.shape, x.dtype),
        shapes,
    )
    tokens = generator.standard_normal((1, 4, *state.patch_tokens.shape[2:]), np.float32)
    cameras, count = generator.standard_normal((1, 5, 2 * tokens.shape[-1]), np.float32), np.array([4], np.int32)
    for function, inputs in (
        (model.windows.encode, (video(),)),
        (model.windows.attend, (state, tokens)),
        (model.refinement.decode_cameras, (cameras, count)),
    ):
        loop, one_by_one = (jax.jit(function)(each, *inputs) for each in (stacks, variables))
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-5, atol=2e-5), loop, one_by_one)


def test_parameters_in_the_compute_type_give_the_same_bits(small_config, small_variables):
    model = LogVGGT(dataclasses.replace(small_config, dtype="bfloat16"))
    half = in_compute_type(small_variables, model.config)
    assert half["params"]["aggregator"]["global_block_0"]["mlp"]["fc1"]["kernel"].dtype == jnp.bfloat16
    assert half["params"]["aggregator"]["global_block_0"]["norm1"]["bias"].dtype == jnp.float32
    assert half["params"]["camera_head"]["trunk_0"]["mlp"]["fc1"]["kernel"].dtype == jnp.float32
    apply = applied(model.config)
    jax.tree.map(np.testing.assert_array_equal, apply(half, video()), apply(small_variables, video()))


def test_gradients_flow_through_the_cache(small_config, small_variables):
    """A loss on the depth of the last window's frames depends on frame 1, which only the cache connects with them."""
    model = LogVGGT(thawed(small_config))
    _, images = streamed_gradient(model, lambda out, _: jnp.log(out.depth[:, -2:]).sum(), small_variables, video())
    assert np.linalg.norm(np.asarray(images)[0, 1]) > 0


def test_bfloat16_stays_close_to_float32(small_config, small_variables):
    """Norm of the difference over norm of the reference."""
    model = LogVGGT(small_config)
    half = LogVGGT(dataclasses.replace(small_config, dtype="bfloat16"))
    # Depths of ordinary size: of exponentials up to a million, one pixel would make up the whole norm.
    variables = jax.tree.map(np.asarray, small_variables)
    output = variables["params"]["depth_head"]["output_2"]
    variables["params"]["depth_head"]["output_2"] = jax.tree.map(lambda x: 0.1 * x, output)
    expected = applied(model.config)(variables, video())
    actual = applied(half.config)(variables, video())
    assert 1.5 < np.asarray(expected.depth).max() < 100
    for name in ("camera_tokens", "register_tokens", "depth", "depth_confidence", "pose_encodings"):
        a, b = np.asarray(getattr(actual, name)), np.asarray(getattr(expected, name))
        assert a.dtype == np.float32
        assert np.linalg.norm(a - b) <= 1e-2 * np.linalg.norm(b), name


def test_parameters_are_float32_whatever_the_compute_type(small_config):
    model = LogVGGT(dataclasses.replace(small_config, dtype="bfloat16"))
    shapes = jax.eval_shape(model.init, jax.random.key(0), video())
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {jnp.dtype("float32")}


def test_uint8_and_float_images_agree(small_config, small_variables):
    pixels = (video() * 255).astype(np.uint8)
    # Nothing but the encoder sees them.
    encode = jax.jit(LogVGGT(small_config).windows.encode)
    a, b = encode(small_variables, pixels), encode(small_variables, pixels.astype(np.float32) / 255)
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_point_head_is_optional(small_config):
    """What it predicts is compared with VGGT's in test_parity.py."""
    head = DPTConfig(features=8, out_channels=(8, 8, 8, 8))
    config = dataclasses.replace(small_config, point_head=head)
    variables = variable_shapes(config)
    out = jax.eval_shape(LogVGGT(config).apply, variables, video())
    assert out.points.shape == (1, FRAMES, 28, 42, 3) and out.points_confidence.shape == (1, FRAMES, 28, 42)
    points, confidence = point_activation(np.array([np.log(3.0), -np.log(2.0), 0.0, 0.0], np.float32))
    np.testing.assert_allclose([*points, confidence], [2.0, -1.0, 0.0, 2.0], rtol=1e-6)
    del variables["params"]["point_head"]
    assert jax.eval_shape(LogVGGT(small_config).apply, variables, video()).points is None


def test_every_prediction_starts_with_the_batch(small_config, small_variables):
    out = jax.eval_shape(LogVGGT(small_config).apply, small_variables, video(batch=3))
    assert {leaf.shape[:2] for leaf in jax.tree.leaves(out)} == {(3, FRAMES)}


@pytest.mark.slow
def test_works_inside_other_peoples_transformations(small_config, small_variables):
    """Under jit as a static argument, and sharded over devices by shard_map."""
    model = LogVGGT(small_config)
    images = video(5, batch=4)
    static = jax.jit(lambda m, v, x: m.apply(v, x).depth, static_argnums=0)
    depth = static(model, small_variables, images)
    mesh = jax.make_mesh((4,), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    data, replicated = jax.P("data"), jax.P()
    sharded = jax.shard_map(model.apply, mesh=mesh, in_specs=(replicated, data), out_specs=data, check_vma=False)
    np.testing.assert_allclose(jax.jit(sharded)(small_variables, images).depth, depth, rtol=1e-4, atol=1e-5)


def test_configuration_survives_json(small_config):
    assert ModelConfig.from_dict(small_config.to_dict()) == small_config
    listed = small_config.to_dict()
    listed["aggregator"]["key_layers"] = list(listed["aggregator"]["key_layers"])
    assert hash(ModelConfig.from_dict(listed)) == hash(small_config)
    listed["aggregator"]["key_layer"] = 3
    with pytest.raises(ValueError, match=r"unknown field model.aggregator.key_layer; .* key_layers"):
        ModelConfig.from_dict(listed)


def test_parameters_are_float32_where_jax_counts_in_64_bits(small_config):
    with jax.enable_x64(True):
        drawn = jax.eval_shape(lambda: LogVGGT(small_config).init(jax.random.key(0), video(1)))
    assert {leaf.dtype for leaf in jax.tree.leaves(drawn)} == {jnp.dtype("float32")}
