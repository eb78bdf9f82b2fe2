"""The network frame by frame is StreamVGGT, and the mask form is the same network: against the original's outputs."""

from __future__ import annotations

import functools
from typing import Any

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_methods import POSES, TOKENS, Golden, assert_depth

from logvggt_jax.model.frame_by_frame import FrameByFrame
from logvggt_jax.model.key_value_cache import CameraMemory, GrowingCache
from logvggt_jax.model.memory import Memory
from logvggt_jax.model.windows import Windows
from logvggt_jax.streaming.causal import CausalSettings, KeepAll
from logvggt_jax.streaming.frame_session import camera_memory


@pytest.fixture(scope="module")
def golden(golden_dir) -> Golden:
    return golden_methods.load(golden_dir, "causal")


@pytest.fixture(scope="module")
def streamed(golden: Golden) -> dict[str, Any]:
    """Tokens of all frames at the key layers, depth, poses of both camera caches, and the caches at the end."""
    images = golden["images_u8"]
    frames, tokens = len(images), golden.settings["tokens_per_frame"]
    keeping = KeepAll(CausalSettings(first_capacity=frames), golden.config.camera_head.iterations)
    blocks, per_round = keeping.start(golden.config, tokens)
    single = camera_memory(golden.config, GrowingCache, frames, per_round=False)
    step = jax.jit(functools.partial(_step, golden))
    found = []
    for index, image in enumerate(images):
        blocks, per_round, single, numbers = step(blocks, per_round, single, image, jnp.array([index == 0]))
        found.append(jax.device_get(numbers))
    stacked = jax.tree.map(lambda *x: np.concatenate(x), *found)
    return {**stacked, "blocks": blocks, "per_round": per_round, "single": single}


def _step(
    golden: Golden, blocks: Memory, per_round: CameraMemory, single: CameraMemory, image: jax.Array, first: jax.Array
) -> tuple[Memory, CameraMemory, CameraMemory, dict[str, jax.Array]]:
    parts, images = FrameByFrame(golden.config), image[None, None]
    tokens, blocks = parts.tokens(golden.variables, blocks, images, first)
    mask = jnp.ones((1, 1), bool)
    out = Windows(golden.config).decode_dense(golden.variables, tokens, mask, images.shape[2:4])
    per_round, poses = parts.locate(golden.variables, per_round, out.camera_tokens, out.register_tokens)
    single, quirky = parts.locate(golden.variables, single, out.camera_tokens, out.register_tokens)
    numbers = {
        "tokens": jnp.moveaxis(tokens.key[0], 1, 0),
        "depth": out.depth[0],
        "depth_conf": out.depth_confidence[0],
    }
    return blocks, per_round, single, {**numbers, "per_round_poses": poses[0], "single_poses": quirky[0]}


def test_tokens_of_a_stream(golden: Golden, streamed: dict[str, Any]) -> None:
    for place, layer in enumerate(golden.config.aggregator.key_layers):
        expected = golden[f"stream_tokens_{layer:02d}"]
        np.testing.assert_allclose(streamed["tokens"][:, place], expected, rtol=0, atol=TOKENS, err_msg=str(layer))


def test_depth_of_a_stream(golden: Golden, streamed: dict[str, Any]) -> None:
    assert_depth(streamed["depth"], golden["stream_depth"])
    assert_depth(streamed["depth_conf"], golden["stream_depth_conf"])


def test_poses_with_a_cache_a_round_are_the_mask_forms(golden: Golden, streamed: dict[str, Any]) -> None:
    found = np.moveaxis(streamed["per_round_poses"], 1, 0)
    np.testing.assert_allclose(found, golden["mask_pose_enc"], rtol=0, atol=POSES)


def test_poses_with_one_cache_are_the_published_ones(golden: Golden, streamed: dict[str, Any]) -> None:
    found = np.moveaxis(streamed["single_poses"], 1, 0)
    np.testing.assert_allclose(found, golden["stream_pose_enc"], rtol=0, atol=POSES)
    assert np.abs(found - golden["mask_pose_enc"]).max() > 1e-3, "the two caches would not be told apart"


def test_caches_hold_what_the_original_has(golden: Golden, streamed: dict[str, Any]) -> None:
    for layer in streamed["blocks"].layers:
        assert int(layer.length) == golden["stream_cache_len"][-1]
    for cache in streamed["single"].trunk.shared.layers:
        assert int(cache.length) == golden["stream_camera_cache_len"][-1]
    for cache in streamed["per_round"].trunk.each.layers:
        assert set(cache.length.tolist()) == {len(golden["images_u8"])}
    tokens = golden.settings["tokens_per_frame"]
    for index, layer in enumerate(golden["cache_layers"]):
        value = np.asarray(streamed["blocks"].layers[layer].value[0])
        for place, frame in enumerate(golden["cache_frames"]):
            found = np.swapaxes(value[frame * tokens : (frame + 1) * tokens], 0, 1)
            np.testing.assert_allclose(found, golden["cache_value"][index, :, place], rtol=0, atol=TOKENS)


def test_the_mask_form(golden: Golden) -> None:
    """One call over the whole sequence: tokens, depth and poses of training under the causal mask."""
    images = golden["images_u8"][None]
    out, poses = jax.device_get(jax.jit(FrameByFrame(golden.config).whole)(golden.variables, images))
    special = golden["mask_tokens_23"][:, :5]
    np.testing.assert_allclose(out.camera_tokens[0], special[:, 0], rtol=0, atol=TOKENS)
    np.testing.assert_allclose(out.register_tokens[0], special[:, 1:], rtol=0, atol=TOKENS)
    assert_depth(out.depth[0], golden["mask_depth"])
    assert_depth(out.depth_confidence[0], golden["mask_depth_conf"])
    np.testing.assert_allclose(np.moveaxis(poses[0], 1, 0), golden["mask_pose_enc"], rtol=0, atol=POSES)
