"""The network is VGGT: outputs, intermediate stages and single layers against the original implementation.

The reference is a small VGGT with random weights (float32, CPU), whose weights are made from their names. Bounds
are on the norm of the difference over the norm of the reference, and tight enough to tell an approximate GELU, a
LayerNorm epsilon or a resampling convention from rounding.
"""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_methods import weight_maker, with_key_layers
from pieces import in_pieces

from logvggt_jax.config import WindowConfig
from logvggt_jax.geometry import (
    decode_poses,
    encode_poses,
    matrix_to_quaternion,
    quaternion_to_matrix,
    unproject,
)
from logvggt_jax.model.aggregator import Aggregator
from logvggt_jax.model.camera_head import CameraHead
from logvggt_jax.model.cross_window import CrossWindowMemory
from logvggt_jax.model.dinov2 import DinoV2
from logvggt_jax.model.dpt_head import DPTHead
from logvggt_jax.model.logvggt import LogVGGT, predictions_of
from logvggt_jax.model.rope import apply_rope, rope_table
from logvggt_jax.types import Predictions
from logvggt_jax.weights import config_from_vggt, params_from_vggt

TOKENS, DENSE, SIZE, GRID = 2e-6, 5e-6, (56, 70), (4, 5)


def relative_error(found, expected):
    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    assert found.shape == expected.shape
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.fixture(scope="module")
def golden(golden_dir):
    with np.load(golden_dir / "vggt_tiny.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def converted(golden_dir):
    """Configuration (one window of all six frames, hence plain VGGT) and parameters."""
    maker = weight_maker(golden_dir)
    state_dict = dict(maker.weights(maker.load_shapes(golden_dir / "vggt_tiny.json")))
    config = dataclasses.replace(config_from_vggt(state_dict, point_head=True), windows=WindowConfig(size=6, stride=2))
    return config, params_from_vggt(state_dict, config)[0]


@functools.partial(in_pieces, static=1)
def one_window(model, variables, images):
    """A sequence of one window, all of whose frames are decoded: the last state, outputs of all frames, the poses."""
    overlap = model.config.windows.size - model.config.windows.stride
    state, out = model.step(variables, model.start(variables, images[:, :overlap]), images[:, overlap:])
    out = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), out, model.finish(variables, state))
    poses = model.refine(variables, out.camera_tokens, out.register_tokens, out.frame_mask, out.frame_mask)
    return state, out, poses


@pytest.fixture(scope="module")
def predictions(golden, converted):
    config, params = converted
    _, out, poses = jax.device_get(one_window(LogVGGT(config), {"params": params}, golden["images_u8"][None]))
    return predictions_of(out, poses, SIZE)


@pytest.fixture(scope="module")
def modules(converted):
    """Encoder, aggregator, depth head and camera head with example arguments."""
    config, _ = converted
    width, patches = config.encoder.embed_dim, GRID[0] * GRID[1]
    mask, lengths, first = np.ones((1, 6), bool), np.full(1, 6, np.int32), np.ones(1, bool)
    nothing = CrossWindowMemory(np.zeros((1, 0), np.float32), np.zeros(1, np.int32), ())

    def zeros(*shape):
        return np.zeros(shape, np.float32)

    return {
        "encoder": (DinoV2(config.encoder, "float32", "auto"), (zeros(6, *SIZE, 3),), {}),
        "aggregator": (
            Aggregator(config),
            (zeros(1, 6, patches, width), lengths, first, nothing),
            {"grid": GRID},
        ),
        "depth_head": (
            DPTHead(config.depth_head, 2, "float32"),
            ([zeros(6, patches, 2 * width)] * 4,),
            {"grid": GRID, "image_size": SIZE},
        ),
        "camera_head": (CameraHead(config.camera_head, "auto"), (zeros(1, 6, 2 * width), mask), {}),
    }


@pytest.fixture(scope="module")
def layers(modules, converted):
    """Every layer of the model as the model builds it: "aggregator/frame_block_3/norm1" -> (module, parameters)."""
    _, params = converted
    found = {}
    for part, (module, arguments, options) in modules.items():

        def record(call, args, kwargs, context, part=part):
            if context.method_name == "__call__" and context.module.path:
                path = (part, *context.module.path)
                own = params
                for key in path:
                    own = own.get(key, {})
                found["/".join(path)] = context.module.clone(parent=None, name=None), own
            return call(*args, **kwargs)

        with nn.intercept_methods(record):
            jax.eval_shape(
                lambda p, m=module, a=arguments, o=options: m.apply({"params": p}, *a, mutable=["intermediates"], **o),
                params[part],
            )
    return found


def _stages(module, params, *args, **kwargs):
    """Outputs of all of a module's layers, by path, the module's own under ""."""
    apply = functools.partial(module.apply, capture_intermediates=True, mutable=["intermediates"], **kwargs)
    out, state = jax.jit(apply)({"params": params}, *args)
    stages = {"": out}
    for path, leaf in jax.tree_util.tree_leaves_with_path(state["intermediates"]):
        names = [key.key for key in path if hasattr(key, "key")]
        stages["/".join(names[:-1])] = leaf  # the last one is "__call__"
    return jax.device_get(stages)


@pytest.fixture(scope="module")
def encoder_stages(golden, converted, modules):
    images = golden["images_u8"].astype(np.float32) / 255
    return _stages(modules["encoder"][0], converted[1]["encoder"], images)


@pytest.fixture(scope="module")
def aggregator_layers(golden, converted, modules):
    """Tokens [6, P, 2C] after every layer, of its frame block before those of its global block on channels."""
    config, params = converted
    module, (_, *rest), options = modules["aggregator"]
    every = module.clone(config=with_key_layers(config, range(config.aggregator.depth)))
    tokens, _ = in_pieces(functools.partial(every.apply, **options))(
        {"params": params["aggregator"]}, golden["dino_patch_tokens"][None], *rest
    )
    return np.asarray(tokens.key)[0]


@pytest.fixture(scope="module")
def first_layer_stages(golden, converted, modules):
    config, params = converted
    module, (_, *rest), options = modules["aggregator"]
    first = module.clone(config=with_key_layers(config, [0], depth=1))
    return _stages(first, params["aggregator"], golden["dino_patch_tokens"][None], *rest, **options)


@pytest.fixture(scope="module")
def depth_stages(golden, converted, modules):
    module, _, options = modules["depth_head"]
    levels = [golden[f"agg_{layer:02d}"][:, 5:] for layer in (4, 11, 17, 23)]
    return _stages(module, converted[1]["depth_head"], levels, **options)


# -- the whole network ------------------------------------------------------------------------------------------


def test_tokens(predictions, golden):
    assert relative_error(predictions.camera_tokens[0], golden["agg_23"][:, 0]) <= TOKENS
    assert relative_error(predictions.register_tokens[0], golden["agg_23"][:, 1:5]) <= TOKENS


@pytest.mark.parametrize("iteration", range(4))
def test_pose_of_every_round(predictions, golden, iteration):
    expected = golden[f"pose_enc_iter{iteration}"]
    assert relative_error(predictions.pose_encodings[0, :, iteration], expected) <= TOKENS
    np.testing.assert_allclose(predictions.pose_encodings[0, :, iteration], expected, rtol=0, atol=5e-6)


def test_depth_and_confidence(predictions, golden):
    assert relative_error(predictions.depth[0], golden["depth"][..., 0]) <= DENSE
    assert relative_error(predictions.depth_confidence[0], golden["depth_conf"]) <= DENSE


def test_points(predictions, golden):
    np.testing.assert_allclose(predictions.points[0], golden["world_points"], rtol=0, atol=1e-4)
    assert relative_error(predictions.points[0], golden["world_points"]) <= DENSE
    assert relative_error(predictions.points_confidence[0], golden["world_points_conf"]) <= DENSE


def test_cameras(predictions, golden):
    assert relative_error(predictions.extrinsics[0], golden["extrinsics"]) <= DENSE
    assert relative_error(predictions.intrinsics[0], golden["intrinsics"]) <= DENSE


@pytest.mark.slow
def test_one_program_of_the_whole_sequence_gives_the_same(predictions, golden, converted):
    """`apply` compiled as users compile it, in which every layer stands in its own place."""
    config, params = converted
    found = jax.jit(LogVGGT(config).apply)({"params": params}, golden["images_u8"][None])
    for field in dataclasses.fields(Predictions):
        assert relative_error(getattr(found, field.name), getattr(predictions, field.name)) <= DENSE, field.name


@pytest.mark.slow
def test_bfloat16_stays_close_to_float32(predictions, golden, converted):
    config, params = converted
    model = LogVGGT(dataclasses.replace(config, dtype="bfloat16"))
    found = jax.jit(model.apply)({"params": params}, golden["images_u8"][None])
    for name in ("camera_tokens", "register_tokens", "depth", "depth_confidence", "pose_encodings"):
        assert relative_error(getattr(found, name), getattr(predictions, name)) <= 1e-2, name


def test_the_first_window_is_vggt_on_its_frames(golden, converted):
    config, params = converted
    model = LogVGGT(dataclasses.replace(config, point_head=None, windows=WindowConfig(size=4, stride=2)))
    variables, images = {"params": params}, golden["images_u8"][None]

    state, out, poses = jax.device_get(one_window(model, variables, images[:, :4]))
    assert relative_error(out.depth[0], golden["win0_depth"][..., 0]) <= DENSE
    assert relative_error(out.depth_confidence[0], golden["win0_depth_conf"]) <= DENSE
    assert relative_error(out.camera_tokens[0], golden["win0_agg_23"][:, 0]) <= TOKENS
    assert relative_error(poses[0, :, -1], golden["win0_pose_enc"]) <= TOKENS
    for i, layer in enumerate((4, 11, 17, 23)):
        assert relative_error(state.key_tokens[0, i], golden[f"win0_agg_{layer:02d}"][2:]) <= TOKENS


# -- stages, each from the reference's input ----------------------------------------------------------------------


def test_encoder_stages(encoder_stages, golden):
    assert relative_error(encoder_stages["patch_embed"], golden["x_dino_patch_conv"]) <= TOKENS
    for i in range(3):
        assert relative_error(encoder_stages[f"block_{i}"], golden[f"x_dino_block{i}"]) <= TOKENS
    assert relative_error(encoder_stages[""], golden["dino_patch_tokens"]) <= TOKENS


@pytest.mark.parametrize("layer", range(24))
def test_aggregator_layers(aggregator_layers, golden, layer):
    for block in (slice(None, 64), slice(64, None)):
        assert relative_error(aggregator_layers[layer, ..., block], golden[f"agg_{layer:02d}"][..., block]) <= TOKENS


def test_first_attention_branches(first_layer_stages, golden):
    for kind in ("frame", "global"):
        for stage, path in (("attn", "/attention"), ("block", "")):
            expected = golden[f"x_{kind}0_{stage}"]
            found = first_layer_stages[f"{kind}_block_0{path}"]
            assert relative_error(found.reshape(expected.shape), expected) <= TOKENS


def test_depth_head_stages(depth_stages, golden):
    names = {f"x_depth_project{i}": f"project_{i}" for i in range(4)}
    names |= {f"x_depth_resize{i}": f"resize_{i}" for i in (0, 1, 3)}
    names |= {f"x_depth_rn{i}": f"layer_{i}" for i in range(1, 5)}
    names |= {f"x_depth_refine{i}": f"refine_{i}" for i in range(1, 5)}
    names |= {"x_depth_outconv1": "output_1", "x_depth_logits": "output_2"}
    for reference, path in names.items():
        expected = np.moveaxis(golden[reference], 1, -1)
        assert relative_error(depth_stages[path], expected) <= DENSE, reference


# -- single layers, on inputs that magnify their constants ----------------------------------------------------------

NORMS = {
    "ln_dino_block0_norm1": ("ln_in64", "encoder/block_0/norm1"),
    "ln_dino_norm": ("ln_in64", "encoder/norm"),
    "ln_frame0_norm1": ("ln_in64", "aggregator/frame_block_0/norm1"),
    "ln_global0_norm2": ("ln_in64", "aggregator/global_block_0/norm2"),
    "ln_frame0_q_norm": ("ln_in16", "aggregator/frame_block_0/attention/query_norm"),
    "ln_global0_k_norm": ("ln_in16", "aggregator/global_block_0/attention/key_norm"),
    "ln_cam_token_norm": ("ln_in128", "camera_head/token_norm"),
    "ln_cam_trunk_norm": ("ln_in128", "camera_head/trunk_norm"),
    "ln_cam_trunk0_norm1": ("ln_in128", "camera_head/trunk_0/norm1"),
    "ln_cam_adaln_norm": ("ln_in128", "camera_head/adaptive_norm"),
    "ln_depth_norm": ("ln_in128", "depth_head/norm"),
}


@pytest.mark.parametrize("name", NORMS)
def test_layer_norms(layers, golden, name):
    source, path = NORMS[name]
    module, params = layers[path]
    found = jax.jit(module.apply)({"params": params}, golden[source])
    np.testing.assert_allclose(found, golden[name], rtol=0, atol=2e-6)
    # The inputs are so small that the other epsilon would show.
    other = module.clone(epsilon=1e-5 if module.epsilon == 1e-6 else 1e-6)
    assert np.abs(jax.jit(other.apply)({"params": params}, golden[source]) - golden[name]).max() > 1e-3


@pytest.mark.parametrize(
    ("name", "source", "path"),
    [
        ("blk_dino1", "blk_in64", "encoder/block_1"),
        ("blk_frame3", "blk_in64", "aggregator/frame_block_3"),
        ("blk_cam_trunk1", "blk_in128", "camera_head/trunk_1"),
    ],
)
def test_blocks(layers, golden, converted, name, source, path):
    module, params = layers[path]

    @jax.jit
    def applied(params, tokens):
        rope = rope_table(GRID, 5, 16, converted[0].aggregator.rope_base) if "frame" in path else None
        return module.apply({"params": params}, tokens, rope=rope)[0]

    found = applied(params, golden[source])
    np.testing.assert_allclose(found, golden[name], rtol=0, atol=2e-6)
    assert relative_error(found, golden[name]) <= TOKENS


def test_rotary_embedding(golden, converted):
    @jax.jit
    def rotated(tokens):
        return apply_rope(tokens, rope_table(GRID, 5, 16, converted[0].aggregator.rope_base))

    found = rotated(np.swapaxes(golden["rope_in"], 1, 2))
    np.testing.assert_allclose(np.swapaxes(found, 1, 2), golden["rope_out"], rtol=0, atol=2e-6)


# -- geometry ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compiled", [False, True], ids=["numpy", "jax"])
def test_geometry(golden, compiled):
    def run(arrays):
        extrinsics, intrinsics = decode_poses(arrays["pose_enc_iter3"], SIZE)
        return {
            "extrinsics": extrinsics,
            "intrinsics": intrinsics,
            "unprojected": unproject(arrays["depth"][..., 0], intrinsics, extrinsics),
            "pose_reencoded": encode_poses(extrinsics, intrinsics, SIZE),
            "quat_mat": quaternion_to_matrix(arrays["quat_in"]),
            "quat_back": matrix_to_quaternion(arrays["quat_mat"]),
        }

    inputs = {name: golden[name] for name in ("pose_enc_iter3", "depth", "quat_in", "quat_mat")}
    for name, found in (jax.jit(run) if compiled else run)(inputs).items():
        assert relative_error(found, golden[name]) <= 1e-6, name
