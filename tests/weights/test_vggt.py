"""VGGT's names and layouts to the parameter tree."""

import dataclasses
import json
from collections.abc import Mapping

import jax
import ml_dtypes
import numpy as np
import pytest

from logvggt_jax.config import DPTConfig, ModelConfig, RefinementConfig, WindowConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.initialization import variable_shapes
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.weights.lazy import LazyTensors
from logvggt_jax.weights.vggt import config_from_vggt, parameter_shapes, params_from_vggt, vggt_rules

WITH_POINTS = ModelConfig(point_head=DPTConfig())


def _zeros(shapes):
    """Tensors of the given shapes that take no memory."""
    return {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}


def _leaves(tree):
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


@pytest.fixture(scope="module")
def shallow(small_config, random_state_dict):
    """A configuration of little depth and a state dict for it."""
    config = dataclasses.replace(small_config, point_head=DPTConfig(features=8, out_channels=(4, 8, 12, 8)))
    return config, random_state_dict(config)


@pytest.fixture(scope="module")
def converted(shallow):
    config, state_dict = shallow
    return params_from_vggt(state_dict, config)


def test_the_table_holds_every_tensor_of_the_released_checkpoint(golden_dir):
    shapes = json.loads((golden_dir / "vggt_1b.json").read_text())["shapes"]
    assert len(shapes) == 1797
    expected = {name: tuple(shape) for name, shape in shapes.items() if not name.startswith("track_head.")}
    assert {rule.name: rule.shape for rule in vggt_rules(WITH_POINTS)} == expected


def test_the_table_fills_the_model_but_for_its_new_parameters():
    config = WITH_POINTS
    expected = {n: leaf.shape for n, leaf in _leaves(parameter_shapes(config)).items() if not n.startswith("gccr/")}
    found = {}
    for rule in vggt_rules(config):
        tensor = np.broadcast_to(np.float32(0), rule.shape)
        for path, layout in rule.targets:
            assert "/".join(path) not in found
            found["/".join(path)] = layout(tensor).shape
    assert found == expected


def test_shapes_are_those_of_init_whatever_they_do_not_depend_on(small_config):
    other = dataclasses.replace(
        small_config,
        camera_head=dataclasses.replace(small_config.camera_head, iterations=2),
        windows=WindowConfig(5, 3, cross_window=False, cache="input"),
        refinement=RefinementConfig(enabled=False, period=3, context=6, max_registers=12, num_heads=2),
        dtype="bfloat16",
        attention="xla",
    )
    images = jax.ShapeDtypeStruct((1, 1, 28, 42, 3), np.float32)
    initial = jax.eval_shape(lambda x: LogVGGT(other).init(jax.random.key(0), x), images)["params"]
    assert variable_shapes(other)["params"] == variable_shapes(small_config)["params"] == initial


def test_layouts(converted, shallow):
    params = jax.device_get(converted[0])
    config, state_dict = shallow
    attention = params["aggregator"]["global_block_3"]["attention"]
    fused, bias = (state_dict[f"aggregator.global_blocks.3.attn.qkv.{leaf}"] for leaf in ("weight", "bias"))
    x = np.random.default_rng(1).standard_normal(config.encoder.embed_dim).astype(np.float32)
    query, key, value = np.split(fused @ x + bias, 3)
    ours = x @ attention["query"]["kernel"] + attention["query"]["bias"]
    np.testing.assert_allclose(ours, query, rtol=1e-5, atol=1e-5)
    both = x @ attention["key_value"]["kernel"] + attention["key_value"]["bias"]
    np.testing.assert_allclose(both, np.concatenate([key, value]), rtol=1e-5, atol=1e-5)

    conv = state_dict["point_head.scratch.layer3_rn.weight"]
    assert params["point_head"]["layer_3"]["kernel"][1, 2, 3, 4] == conv[4, 3, 1, 2]
    transposed = state_dict["depth_head.resize_layers.0.weight"]
    assert params["depth_head"]["resize_0"]["kernel"][3, 1, 0, 2] == transposed[0, 2, 3, 1]
    patches = state_dict["aggregator.patch_embed.patch_embed.proj.weight"]
    assert params["encoder"]["patch_embed"]["kernel"][13, 2, 1, 5] == patches[5, 1, 13, 2]
    modulation = state_dict["camera_head.poseLN_modulation.1.weight"]
    assert params["camera_head"]["modulation"]["kernel"][3, 40] == modulation[40, 3]


def test_the_report_names_what_was_used_skipped_and_initialised(converted, shallow, small_config):
    _, report = converted
    _, state_dict = shallow
    track = {name for name in state_dict if name.startswith("track_head.")}
    assert set(report.skipped) == track
    assert set(report.used) == set(state_dict) - track and len(report.used) == len(set(report.used))
    assert len(report.initialised) == 12 and all(name.startswith("gccr/") for name in report.initialised)

    params, report = params_from_vggt(state_dict, small_config)
    assert "point_head" not in params
    assert set(report.skipped) == {n for n in state_dict if n.startswith(("track_head.", "point_head."))}


def test_new_parameters_are_those_of_init_and_leave_vggt_unchanged(shallow, small_config):
    _, state_dict = shallow
    found = params_from_vggt(state_dict, small_config)[0]["gccr"]
    assert not np.any(found["output"]["kernel"]) and not np.any(found["output"]["bias"])
    assert np.any(found["query"]["kernel"])
    images = np.zeros((1, 1, 28, 42, 3), np.float32)
    initial = jax.jit(lambda: LogVGGT(small_config).init(jax.random.key(0), images)["params"]["gccr"])()
    for name, leaf in _leaves(found).items():
        np.testing.assert_allclose(leaf, _leaves(initial)[name], rtol=1e-6)


def test_tensors_are_read_once_cast_and_copied(shallow):
    config, state_dict = shallow
    source = {name: tensor.copy() for name, tensor in state_dict.items()}
    half = "aggregator.patch_embed.cls_token"
    source[half] = source[half].astype(ml_dtypes.bfloat16)
    expected = source[half].astype(np.float32)
    reads = []

    def read(name):
        reads.append(name)
        return source[name]

    params, report = params_from_vggt(LazyTensors(list(source), read), config)
    assert reads == report.used
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(params))
    np.testing.assert_array_equal(params["encoder"]["cls_token"], expected)

    source["aggregator.patch_embed.norm.weight"][:] = 7
    before = state_dict["aggregator.patch_embed.norm.weight"]
    np.testing.assert_array_equal(params["encoder"]["norm"]["scale"], before)


def test_a_lazy_mapping_of_somebody_elses_is_read_once(shallow):
    """One that says by reading whether a name is there, as `collections.abc.Mapping` does."""
    config, source = shallow
    read = []

    class Lazy(Mapping):
        def __getitem__(self, name):
            read.append(name)
            return source[name]

        def __iter__(self):
            return iter(source)

        def __len__(self):
            return len(source)

    _, report = params_from_vggt(Lazy(), config)
    assert sorted(read) == sorted(report.used)


def test_an_unknown_key_is_refused(vggt_state_dict, vggt_config):
    extra = {**vggt_state_dict, "aggregator.frame_blocks.0.attn.relative.weight": np.zeros(3, np.float32)}
    with pytest.raises(ValueError, match=r"unknown key 'aggregator\.frame_blocks\.0\.attn\.relative\.weight'"):
        params_from_vggt(extra, vggt_config)


def test_missing_keys_are_counted_and_named(vggt_state_dict, vggt_config):
    lost = ("camera_head.token_norm.weight", "camera_head.embed_pose.bias")
    fewer = {name: tensor for name, tensor in vggt_state_dict.items() if name not in lost}
    with pytest.raises(ValueError, match=r"^2 of \d+ keys are missing.*token_norm\.weight, .*embed_pose\.bias"):
        params_from_vggt(fewer, vggt_config)


@pytest.mark.parametrize("lost", ["aggregator.camera_token", "aggregator.frame_blocks.3."])
def test_a_missing_key_that_tells_a_size_is_said_once(vggt_state_dict, vggt_config, lost):
    fewer = {name: tensor for name, tensor in vggt_state_dict.items() if not name.startswith(lost)}
    with pytest.raises(InputError, match=r"^\d+ of \d+ keys are missing") as raised:
        params_from_vggt(fewer, vggt_config)
    message = str(raised.value)
    assert lost in message and message.count("it holds") == 1 and "lacks" not in message


def test_a_misshapen_tensor_is_named_with_both_shapes(vggt_state_dict, vggt_config):
    bad = {**vggt_state_dict, "camera_head.embed_pose.weight": np.zeros((32, 8), np.float32)}
    with pytest.raises(ValueError, match=r"embed_pose\.weight has shape \(32, 8\), expected \(32, 9\).*damaged"):
        params_from_vggt(bad, vggt_config)


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("encoder", "position_grid", 5),
        ("encoder", "depth", 2),
        ("aggregator", "num_heads", 4),
        ("depth_head", "features", 16),
        ("depth_head", "out_channels", (4, 8, 12, 16)),
    ],
)
def test_another_size_names_the_field_to_change(vggt_state_dict, vggt_config, part, field, value):
    changed = dataclasses.replace(getattr(vggt_config, part), **{field: value})
    config = dataclasses.replace(vggt_config, **{part: changed})
    right = getattr(getattr(vggt_config, part), field)
    with pytest.raises(ValueError) as caught:
        params_from_vggt(vggt_state_dict, config)
    assert f"{part}.{field} is {value}, the state dict's {right}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_integers_are_no_weights(vggt_state_dict, vggt_config):
    bad = {**vggt_state_dict, "camera_head.embed_pose.bias": np.zeros(32, np.int32)}
    with pytest.raises(ValueError, match=r"embed_pose\.bias is int32, expected one of float32"):
        params_from_vggt(bad, vggt_config)


def test_sizes_are_read_off_the_released_checkpoint(golden_dir):
    state_dict = _zeros(json.loads((golden_dir / "vggt_1b.json").read_text())["shapes"])
    assert config_from_vggt(state_dict, point_head=True) == WITH_POINTS
    assert config_from_vggt(state_dict) == ModelConfig()


def test_sizes_are_read_off_a_small_state_dict(vggt_state_dict, vggt_config):
    assert config_from_vggt(vggt_state_dict, point_head=True) == vggt_config
    assert config_from_vggt(vggt_state_dict).refinement == RefinementConfig(num_heads=2)


def test_sizes_that_cannot_be_read_are_errors(vggt_state_dict):
    shallow = {n: t for n, t in vggt_state_dict.items() if "_blocks.23." not in n}
    with pytest.raises(ValueError, match=r"23 aggregator blocks.*params_from_vggt"):
        config_from_vggt(shallow)
    with pytest.raises(ValueError, match=r"lacks aggregator\.camera_token.*holds 1 tensors, encoder\.weight \(3,\)"):
        config_from_vggt({"encoder.weight": np.zeros(3, np.float32)})
    oblong = {**vggt_state_dict, "aggregator.patch_embed.pos_embed": np.zeros((1, 9, 16), np.float32)}
    with pytest.raises(ValueError, match="8 grid positions, expected a square"):
        config_from_vggt(oblong)


def test_one_share_of_a_training_in_shards_is_named(vggt_state_dict):
    shares = {name: np.zeros(0, np.float32) for name in vggt_state_dict}
    with pytest.raises(InputError, match=r"is empty, as in one process's share.*zero_to_fp32"):
        config_from_vggt(shares)


def test_a_state_dict_without_point_head_gives_none(vggt_state_dict):
    without = {n: t for n, t in vggt_state_dict.items() if not n.startswith("point_head.")}
    with pytest.raises(ValueError, match=r"lacks point_head\."):
        config_from_vggt(without, point_head=True)


@pytest.mark.parametrize("lost", ["aggregator.frame_blocks.5.", "aggregator.global_blocks.5.", "camera_head.trunk.0."])
def test_a_missing_block_is_named(vggt_state_dict, lost):
    fewer = {name: tensor for name, tensor in vggt_state_dict.items() if not name.startswith(lost)}
    with pytest.raises(InputError, match=f"lacks {lost[:-1]}: it has .* expected .*holds {len(fewer)} tensors"):
        config_from_vggt(fewer)


@pytest.mark.parametrize("lost", ["aggregator.patch_embed.blocks.23.", "camera_head.trunk.3."])
def test_a_last_block_that_the_width_asks_for_is_named(golden_dir, lost):
    shapes = json.loads((golden_dir / "vggt_1b.json").read_text())["shapes"]
    fewer = _zeros({name: shape for name, shape in shapes.items() if not name.startswith(lost)})
    with pytest.raises(InputError, match=f"lacks {lost[:-1]}: "):
        config_from_vggt(fewer)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (np.nan, r"1 of \d+ values NaN or infinite, first at \(7, 3\)"),
        (np.inf, r"1 of \d+ values NaN or infinite, first at \(7, 3\)"),
        (-1e300, r"numbers up to 1e\+300, too large for float32"),
    ],
)
def test_values_that_are_not_finite_are_refused_by_name(vggt_state_dict, vggt_config, value, said):
    name = "aggregator.frame_blocks.0.attn.qkv.weight"
    bad = vggt_state_dict[name].astype(np.float64)
    bad[7, 3] = value
    with pytest.raises(InputError, match=rf"^{name} has {said}"):
        params_from_vggt({**vggt_state_dict, name: bad}, vggt_config)


def test_constants_are_skipped_and_the_mask_token_may_be_missing(vggt_state_dict, vggt_config):
    state_dict = {**vggt_state_dict, "aggregator._resnet_mean": np.zeros((1, 1, 3, 1, 1), np.float32)}
    del state_dict["aggregator.patch_embed.mask_token"]
    params, report = params_from_vggt(state_dict, vggt_config)
    assert "aggregator._resnet_mean" in report.skipped and "encoder/mask_token" in report.initialised
    assert params["encoder"]["mask_token"].shape == (1, vggt_config.encoder.embed_dim)
