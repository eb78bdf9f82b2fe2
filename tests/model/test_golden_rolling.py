"""The rolling memory is InfiniteVGGT's: what it keeps, its budgets and scores, and what comes of them."""

from __future__ import annotations

from typing import Any

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_methods import POSES, TOKENS, Golden, assert_depth, frame_step

from logvggt_jax.model import rolling_cache
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

        def step(memory: StreamMemory, image: np.ndarray, first: np.ndarray) -> tuple[StreamMemory, dict[str, Any]]:
            after, numbers = frame_step(golden.config, golden.variables, memory, image, first)
            layers, entries = after.blocks.layers, after.camera.trunk.shared.layers
            scalars = {
                "budget": [layer.budget for layer in layers],
                "cache_len": [layer.length for layer in layers],
                "score_before": memory.blocks.scores,
                "score_after": after.blocks.scores,
                "camera_cache_len": [cache.length for cache in entries],
            }
            return after, jax.device_get(numbers) | {name: np.asarray(x)[None] for name, x in scalars.items()}

        self.step, self.recorded = step, recorded

    def run(self, images: np.ndarray, total: str = "total_budget") -> dict[str, Any]:
        """Everything of a new sequence, and `kept`: for every frame the token numbers [heads, n] of each layer."""
        config, tokens = self.golden.config, self.golden.settings["tokens_per_frame"]
        budget, temperature = self.golden.settings[total], self.golden.settings["temperature"]
        settings = RollingSettings(budget, temperature, camera_cache="single")
        keeping = KeepWithinBudget(settings, config.camera_head.iterations)
        memory, found, kept, scores = keeping.start(config, tokens), [], [], []
        held = [np.zeros((config.aggregator.num_heads, 0), int)] * config.aggregator.depth
        for index, image in enumerate(images):
            memory = keeping.make_room(memory, tokens, index)
            self.evictions.clear()
            memory, numbers = self.step(memory, image, np.array([index == 0]))
            found.append(numbers)
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
    assert (evicting["camera_cache_len"] == golden["evict_camera_cache_len"][:, None]).all()
    anchors = [layer.anchor for layer in evicting["memory"].blocks.layers]
    np.testing.assert_array_equal(anchors, golden["evict_anchor_len"])
    # Of the original's own scores, whose products with the budget are stored before they are truncated.
    total, temperature = golden.settings["total_budget"], golden.settings["temperature"]
    budgets = jax.jit(rolling_cache.budgets)
    for scores, budget, product in zip(
        golden["evict_score_before"], golden["evict_budget"], golden["evict_budget_product"], strict=True
    ):
        np.testing.assert_array_equal(budgets(scores, total, temperature), budget)
        np.testing.assert_array_equal(np.floor(product), budget)


def test_mean_and_margin_of_every_selection(golden: Golden, evicting: dict[str, Any]) -> None:
    """In all layers and heads: the mean score, and how far the first that goes lies above the last that stays."""
    tokens = golden.settings["tokens_per_frame"]
    for index, by_layer in enumerate(evicting["scores"]):
        assert set(by_layer) == set(np.flatnonzero(np.isfinite(golden["evict_score_mean"][index, :, 0])))
        for layer, scores in by_layer.items():
            held = evicting["cache_len"][index - 1, layer] + tokens
            ranked = np.sort(scores[tokens:held], axis=0)
            np.testing.assert_allclose(ranked.mean(0), golden["evict_score_mean"][index, layer], rtol=0, atol=SCORES)
            stay = evicting["budget"][index, layer] - tokens
            if not stay:  # the anchor alone
                continue
            gap = ranked[stay] - ranked[stay - 1]
            np.testing.assert_allclose(gap, golden["evict_score_gap"][index, layer], rtol=0, atol=2 * SCORES)


def test_what_is_kept_and_by_which_scores(golden: Golden, evicting: dict[str, Any]) -> None:
    tokens, evictions = golden.settings["tokens_per_frame"], 0
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
                evictions += 1
    assert evictions, "the sequence must be long enough to evict"


def test_caches_at_the_end(golden: Golden, evicting: dict[str, Any]) -> None:
    for layer in golden.settings["detail_layers"]:
        cache = evicting["memory"].blocks.layers[layer]
        for name in ("key", "value"):
            found = np.swapaxes(np.asarray(getattr(cache, name))[0, : int(cache.length)], 0, 1)
            np.testing.assert_allclose(found, golden[f"evict_final_{name}_{layer:02d}"], rtol=0, atol=TOKENS)


def test_tokens_depth_and_poses(golden: Golden, evicting: dict[str, Any]) -> None:
    _assert_numbers(golden, "evict", evicting)


def _assert_numbers(golden: Golden, name: str, found: dict[str, Any]) -> None:
    for place, layer in enumerate(golden.config.aggregator.key_layers):
        tokens, expected = found["tokens"][:, place], golden[f"{name}_tokens_{layer:02d}"]
        if expected.shape[1] != tokens.shape[1]:
            tokens = tokens[:, golden["token_index"]]
        np.testing.assert_allclose(tokens, expected, rtol=0, atol=TOKENS, err_msg=f"block {layer}")
    assert_depth(found["depth"], golden[f"{name}_depth"])
    assert_depth(found["depth_conf"], golden[f"{name}_depth_conf"])
    np.testing.assert_allclose(np.moveaxis(found["poses"], 1, 0), golden[f"{name}_pose_enc"], rtol=0, atol=POSES)


@pytest.mark.slow
def test_a_budget_that_nothing_exceeds(golden: Golden, stream: Stream) -> None:
    """Caches of another size, and so another program."""
    _assert_numbers(golden, "never", stream.run(golden["images_u8"], "total_budget_never"))


def test_a_second_sequence_starts_afresh(golden: Golden, stream: Stream, evicting: dict[str, Any]) -> None:
    """In the original it starts with the first one's scores and anchor."""
    second = stream.run(golden["images_second_u8"])
    np.testing.assert_array_equal(second["budget"], golden["second_fresh_budget"])
    assert (second["budget"] != golden["second_leaked_budget"]).any()
    assert not second["score_before"][0].any() and golden["second_leaked_score_before"][0].any()
    poses = np.moveaxis(second["poses"], 1, 0)
    np.testing.assert_allclose(poses, golden["second_fresh_pose_enc"], rtol=0, atol=POSES)
    tokens = second["tokens"][:, -1][:, golden["token_index"]]
    last = golden.config.aggregator.key_layers[-1]
    np.testing.assert_allclose(tokens, golden[f"second_fresh_tokens_{last:02d}"], rtol=0, atol=TOKENS)
    assert np.abs(poses - golden["second_leaked_pose_enc"]).max() > 1e-3
