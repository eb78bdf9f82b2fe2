"""The network frame by frame is StreamVGGT, and the mask form is the same network: against the original's outputs."""

from __future__ import annotations

import functools
from typing import Any

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_methods import POSES, TOKENS, Golden, assert_depth, with_key_layers
from pieces import in_pieces

from logvggt_jax.model.aggregator import WindowTokens
from logvggt_jax.model.frame_by_frame import CausalMask, FrameByFrame
from logvggt_jax.model.key_value_cache import CameraMemory, GrowingCache
from logvggt_jax.model.memory import Memory
from logvggt_jax.model.rope import apply_rope, rope_table
from logvggt_jax.model.windows import Windows
from logvggt_jax.streaming.causal import CausalSettings, KeepAll
from logvggt_jax.streaming.frame_session import camera_memory


@pytest.fixture(scope="module")
def golden(golden_dir) -> Golden:
    return golden_methods.load(golden_dir, "causal")


@pytest.fixture(scope="module")
def streamed(golden: Golden) -> dict[str, Any]:
    """Tokens of all frames at the stored layers, depth, poses of both camera caches, lengths, and the caches at the
    end."""
    images = golden["images_u8"]
    frames, tokens = len(images), golden.settings["tokens_per_frame"]
    keeping = KeepAll(CausalSettings(first_capacity=frames), golden.config.camera_head.iterations)
    blocks, per_round = keeping.start(golden.config, tokens)
    single = camera_memory(golden.config, GrowingCache, frames, per_round=False)
    found = []
    for index, image in enumerate(images):
        blocks, per_round, single, numbers = _step(golden, blocks, per_round, single, image, np.array([index == 0]))
        lengths = {
            "cache_len": [layer.length for layer in blocks.layers],
            "camera_cache_len": [cache.length for cache in single.trunk.shared.layers],
        }
        found.append(jax.device_get({**numbers, **{name: np.stack(each)[None] for name, each in lengths.items()}}))
    stacked = jax.tree.map(lambda *x: np.concatenate(x), *found)
    return {**stacked, "blocks": blocks, "per_round": per_round, "single": single}


def _stored_layers(golden: Golden, form: str) -> list[int]:
    """The layers whose tokens are stored, those of the depth head and some besides."""
    return sorted(int(name.rsplit("_", 1)[1]) for name in golden.arrays if name.startswith(f"{form}_tokens_"))


def _tokens(golden: Golden, form: str, *given: Any) -> tuple[WindowTokens, WindowTokens, Any]:
    """Tokens at all stored layers, those of the depth head's layers, and the memory."""
    layers = _stored_layers(golden, form)
    parts = FrameByFrame(with_key_layers(golden.config, layers))
    tokens, memory = parts.tokens(golden.variables, *given)
    chosen = np.array([layers.index(layer) for layer in golden.config.aggregator.key_layers])
    return tokens, tokens._replace(key=tokens.key[:, chosen]), memory


@functools.partial(in_pieces, static=1)
def _step(
    golden: Golden, blocks: Memory, per_round: CameraMemory, single: CameraMemory, image: jax.Array, first: jax.Array
) -> tuple[Memory, CameraMemory, CameraMemory, dict[str, jax.Array]]:
    parts, images = FrameByFrame(golden.config), image[None, None]
    stored, tokens, blocks = _tokens(golden, "stream", blocks, images, first)
    mask = jnp.ones((1, 1), bool)
    out = Windows(golden.config).decode_dense(golden.variables, tokens, mask, images.shape[2:4])
    per_round, poses = parts.locate(golden.variables, per_round, out.camera_tokens, out.register_tokens)
    single, quirky = parts.locate(golden.variables, single, out.camera_tokens, out.register_tokens)
    numbers = {
        "tokens": jnp.moveaxis(stored.key[0], 1, 0),
        "depth": out.depth[0],
        "depth_conf": out.depth_confidence[0],
    }
    return blocks, per_round, single, {**numbers, "per_round_poses": poses[0], "single_poses": quirky[0]}


def test_tokens_of_a_stream(golden: Golden, streamed: dict[str, Any]) -> None:
    for place, layer in enumerate(_stored_layers(golden, "stream")):
        expected = golden[f"stream_tokens_{layer:02d}"]
        np.testing.assert_allclose(streamed["tokens"][:, place], expected, rtol=0, atol=TOKENS, err_msg=str(layer))


def test_depth_of_a_stream(golden: Golden, streamed: dict[str, Any]) -> None:
    assert_depth(streamed["depth"], golden["stream_depth"])
    assert_depth(streamed["depth_conf"], golden["stream_depth_conf"])


def test_poses_with_a_cache_a_round_are_the_mask_forms(golden: Golden, streamed: dict[str, Any]) -> None:
    found = np.moveaxis(streamed["per_round_poses"], 1, 0)
    np.testing.assert_allclose(found, golden["mask_pose_enc"], rtol=0, atol=POSES)
    np.testing.assert_allclose(found[0], golden["camera_one_round_pose_enc"], rtol=0, atol=POSES)


def test_poses_with_one_cache_are_the_published_ones(golden: Golden, streamed: dict[str, Any]) -> None:
    found = np.moveaxis(streamed["single_poses"], 1, 0)
    np.testing.assert_allclose(found, golden["stream_pose_enc"], rtol=0, atol=POSES)
    quirk = np.abs(found - np.moveaxis(streamed["per_round_poses"], 1, 0)).max(-1)
    np.testing.assert_allclose(quirk, golden["pose_stream_minus_mask"], rtol=0, atol=2 * POSES)
    assert quirk.max() > 1e-3, "the two caches would not be told apart"


def test_caches_hold_what_the_original_has(golden: Golden, streamed: dict[str, Any]) -> None:
    for name in ("cache_len", "camera_cache_len"):
        assert (streamed[name] == golden[f"stream_{name}"][:, None]).all()
    # In round r a camera token sees what the frames before left, and its own entries up to that round's.
    before = np.concatenate([[0], streamed["camera_cache_len"][:-1, 0]])
    attended = before + 1 + np.arange(golden.config.camera_head.iterations)[:, None]
    np.testing.assert_array_equal(attended, golden["camera_keys_attended"])
    for cache in streamed["per_round"].trunk.each.layers:
        assert set(cache.length.tolist()) == {len(golden["images_u8"])}
    tokens, images = golden.settings["tokens_per_frame"], golden["images_u8"]
    grid = (images.shape[1] // 14, images.shape[2] // 14)
    for index, layer in enumerate(golden["cache_layers"]):
        cache, raw = streamed["blocks"].layers[layer], golden["cache_key_raw"][index]
        norm = golden.variables["params"]["aggregator"][f"global_block_{layer}"]["attention"]["key_norm"]
        special = tokens - grid[0] * grid[1]

        @jax.jit
        def rotated(key: jax.Array, special: int = special, width: int = raw.shape[-1]) -> jax.Array:
            return apply_rope(key[None], rope_table(grid, special, width, golden.config.aggregator.rope_base))[0]

        for place, frame in enumerate(golden["cache_frames"]):
            span = slice(frame * tokens, (frame + 1) * tokens)
            value = np.swapaxes(np.asarray(cache.value)[0, span], 0, 1)
            np.testing.assert_allclose(value, golden["cache_value"][index, :, place], rtol=0, atol=TOKENS)
            # The original keeps keys as they are before norm and rotation.
            key = np.swapaxes(raw[:, place], 0, 1)
            key = (key - key.mean(-1, keepdims=True)) / np.sqrt(key.var(-1, keepdims=True) + 1e-5)
            key = key * np.asarray(norm["scale"]) + np.asarray(norm["bias"])
            np.testing.assert_allclose(np.asarray(cache.key)[0, span], rotated(key), rtol=0, atol=TOKENS)


@pytest.mark.slow
def test_the_mask_form(golden: Golden) -> None:
    """One call over the whole sequence: tokens, depth and poses of training under the causal mask."""
    images = golden["images_u8"][None]

    @jax.jit
    def run(images: jax.Array) -> Any:
        stored, _, _ = _tokens(golden, "mask", CausalMask(images.shape[1]), images, jnp.ones(1, bool))
        return stored.key[0], FrameByFrame(golden.config).whole(golden.variables, images)

    key, (out, poses) = jax.device_get(run(images))
    for place, layer in enumerate(_stored_layers(golden, "mask")):
        expected = golden[f"mask_tokens_{layer:02d}"]
        np.testing.assert_allclose(key[place], expected, rtol=0, atol=TOKENS, err_msg=str(layer))
    assert_depth(out.depth[0], golden["mask_depth"])
    assert_depth(out.depth_confidence[0], golden["mask_depth_conf"])
    np.testing.assert_allclose(np.moveaxis(poses[0], 1, 0), golden["mask_pose_enc"], rtol=0, atol=POSES)
