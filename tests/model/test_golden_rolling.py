"""The rolling memory is InfiniteVGGT's: what it keeps, its budgets and scores, and what comes of them."""

from __future__ import annotations

from typing import Any

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_methods import POSES, TOKENS, Golden, assert_depth

from logvggt_jax.model import rolling_cache
from logvggt_jax.model.frame_by_frame import FrameByFrame
from logvggt_jax.model.windows import Windows
from logvggt_jax.streaming.frame_session import StreamMemory
from logvggt_jax.streaming.rolling import KeepWithinBudget, RollingSettings

SCORES = 2e-6


@pytest.fixture(scope="module")
def golden(golden_dir) -> Golden:
    return golden_methods.load(golden_dir, "rolling")


class Stream:
    """The network frame by frame with a rolling memory, and a record of what each layer kept."""

    def __init__(self, golden: Golden) -> None:
        self.golden, self.evictions = golden, []
        choose = rolling_cache.choose_kept

        def recorded(key: jax.Array, length: jax.Array, budget: jax.Array, anchor: int) -> tuple[jax.Array, jax.Array]:
            place = jnp.arange(key.shape[1])[:, None]
            scores = rolling_cache.similarity_to_mean(key, (place >= anchor) & (place < length))
            kept, mean = choose(key, length, budget, anchor)
            jax.debug.callback(lambda *x: self.evictions.append(x), kept[0], scores[0], length, ordered=True)
            return kept, mean

        @jax.jit
        def step(memory: StreamMemory, image: jax.Array, first: jax.Array) -> tuple[StreamMemory, dict[str, Any]]:
            parts, images = FrameByFrame(golden.config), image[None, None]
            tokens, blocks = parts.tokens(golden.variables, memory.blocks, images, first)
            mask = jnp.ones((1, 1), bool)
            out = Windows(golden.config).decode_dense(golden.variables, tokens, mask, images.shape[2:4])
            camera, poses = parts.locate(golden.variables, memory.camera, out.camera_tokens, out.register_tokens)
            layers = blocks.layers
            return StreamMemory(blocks, camera), {
                "tokens": jnp.moveaxis(tokens.key[0], 1, 0),
                "depth": out.depth[0],
                "depth_conf": out.depth_confidence[0],
                "poses": poses[0],
                "budget": jnp.stack([layer.budget for layer in layers])[None],
                "cache_len": jnp.stack([layer.length for layer in layers])[None],
                "score_before": memory.blocks.scores[None],
                "score_after": blocks.scores[None],
            }

        self.step, self.recorded = step, recorded

    def run(self, images: np.ndarray) -> dict[str, Any]:
        """Everything of a new sequence, and `kept`: for every frame the token numbers [heads, n] of each layer."""
        config, tokens = self.golden.config, self.golden.settings["tokens_per_frame"]
        settings = RollingSettings(self.golden.settings["total_budget"], camera_cache="single")
        keeping = KeepWithinBudget(settings, config.camera_head.iterations)
        memory, found, kept, scores = keeping.start(config, tokens), [], [], []
        held = [np.zeros((config.aggregator.num_heads, 0), int)] * config.aggregator.depth
        for index, image in enumerate(images):
            memory = keeping.make_room(memory, tokens, index)
            self.evictions.clear()
            memory, numbers = self.step(memory, image, jnp.array([index == 0]))
            found.append(jax.device_get(numbers))
            jax.effects_barrier()
            records, layer_scores = iter(self.evictions), {}
            for layer, budget in enumerate(found[-1]["budget"][0]):
                new = np.broadcast_to(index * tokens + np.arange(tokens), (len(held[layer]), tokens))
                held[layer] = np.concatenate([held[layer], new], axis=1)
                if held[layer].shape[1] > budget:
                    places, layer_scores[layer], length = (np.asarray(x) for x in next(records))
                    assert length == held[layer].shape[1]
                    held[layer] = np.take_along_axis(held[layer], places[:budget].T, axis=1)
            assert next(records, None) is None
            kept.append(list(held))
            scores.append(layer_scores)
        stacked = jax.tree.map(lambda *x: np.concatenate(x), *found)
        return {**stacked, "memory": memory, "kept": kept, "scores": scores}


@pytest.fixture(scope="module")
def stream(golden: Golden) -> Stream:
    return Stream(golden)


@pytest.fixture(scope="module")
def evicting(golden: Golden, stream: Stream) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rolling_cache, "choose_kept", stream.recorded)
        return stream.run(golden["images_u8"])


def test_budgets_scores_and_lengths(golden: Golden, evicting: dict[str, Any]) -> None:
    np.testing.assert_array_equal(evicting["budget"], golden["evict_budget"])
    np.testing.assert_array_equal(evicting["cache_len"], golden["evict_cache_len"])
    for name in ("score_before", "score_after"):
        np.testing.assert_allclose(evicting[name], golden[f"evict_{name}"], rtol=0, atol=SCORES)


def test_what_is_kept_and_by_which_scores(golden: Golden, evicting: dict[str, Any]) -> None:
    tokens, evicted = golden.settings["tokens_per_frame"], 0
    for index in range(len(golden["images_u8"])):
        for place, layer in enumerate(golden.settings["detail_layers"]):
            kept, expected = evicting["kept"][index][layer], golden["evict_kept_tokens"][index, place]
            np.testing.assert_array_equal(kept, expected[:, : kept.shape[1]], err_msg=f"frame {index}, layer {layer}")
            assert (expected[:, kept.shape[1] :] == -1).all()
            expected = golden["evict_scores"][index, place]
            count = int(np.isfinite(expected[0]).sum())
            assert (count > 0) == (layer in evicting["scores"][index])
            if count:
                found = evicting["scores"][index][layer][tokens : tokens + count].T
                np.testing.assert_allclose(found, expected[:, :count], rtol=0, atol=SCORES)
                evicted += 1
    assert evicted > 5, "the sequence must be long enough to evict"


def test_caches_at_the_end(golden: Golden, evicting: dict[str, Any]) -> None:
    for layer in golden.settings["detail_layers"]:
        cache = evicting["memory"].blocks.layers[layer]
        for name in ("key", "value"):
            found = np.swapaxes(np.asarray(getattr(cache, name))[0, : int(cache.length)], 0, 1)
            np.testing.assert_allclose(found, golden[f"evict_final_{name}_{layer:02d}"], rtol=0, atol=TOKENS)


def test_tokens_depth_and_poses(golden: Golden, evicting: dict[str, Any]) -> None:
    layers = golden.config.aggregator.key_layers
    for place, layer in enumerate(layers):
        found = evicting["tokens"][:, place]
        if layer != layers[-1]:
            found = found[:, golden["token_index"]]
        np.testing.assert_allclose(found, golden[f"evict_tokens_{layer:02d}"], rtol=0, atol=TOKENS)
    assert_depth(evicting["depth"], golden["evict_depth"])
    assert_depth(evicting["depth_conf"], golden["evict_depth_conf"])
    np.testing.assert_allclose(np.moveaxis(evicting["poses"], 1, 0), golden["evict_pose_enc"], rtol=0, atol=POSES)


def test_a_second_sequence_starts_afresh(golden: Golden, stream: Stream, evicting: dict[str, Any]) -> None:
    """In the original it starts with the first one's scores and anchor."""
    second = stream.run(golden["images_second_u8"])
    np.testing.assert_array_equal(second["budget"], golden["second_fresh_budget"])
    poses = np.moveaxis(second["poses"], 1, 0)
    np.testing.assert_allclose(poses, golden["second_fresh_pose_enc"], rtol=0, atol=POSES)
    tokens = second["tokens"][:, -1][:, golden["token_index"]]
    np.testing.assert_allclose(tokens, golden["second_fresh_tokens_23"], rtol=0, atol=TOKENS)
    assert np.abs(poses - golden["second_leaked_pose_enc"]).max() > 1e-3
