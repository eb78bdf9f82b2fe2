"""Merged tokens: FastVGGT's own numbers, and plain VGGT's where nothing is merged."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model import merging as module
from logvggt_jax.model.memory import Keys, OwnTokens
from logvggt_jax.model.merging import TokenMerging, merging_of
from logvggt_jax.model.parameters import run
from logvggt_jax.streaming import MergedSession, MergedSettings, OfflineSession, OfflineSettings
from logvggt_jax.streaming.merged import merged_program, merging_for
from logvggt_jax.streaming.offline import offline_program, plain_vggt

IMAGES = np.random.default_rng(0).integers(0, 256, (4, 28, 42, 3), np.uint8)
RUNS = ("default", "exact", "low", "zero")


@pytest.fixture(scope="module")
def golden(golden_method) -> Any:
    return golden_method("merged")


def _merging(golden: Any, name: str) -> TokenMerging | None:
    """A golden run's merging with the published order of destinations, which decides between equally similar ones."""
    images, sizes = golden.arrays["images_u8"], golden.sizes
    settings = MergedSettings(
        ratio={"low": sizes["ratio_low"], "zero": 0.0}.get(name, sizes["ratio_default"]),
        protected=sizes["protected"],
        similarity="bfloat16" if name == "default" else "float32",
    )
    merging = merging_for(LogVGGT(golden.config), len(images), images.shape[1:3], settings)
    if merging is None:
        return None
    published = {key: golden.arrays[f"{key[:-1]}_tokens"] for key in ("sources", "destinations")}
    published["sources"] = published["sources"][~np.isin(published["sources"], golden.arrays["protected_tokens"])]
    for key, tokens in published.items():
        assert sorted(getattr(merging, key).tolist()) == sorted(tokens.tolist())
    np.testing.assert_array_equal(merging.protected, golden.arrays["protected_tokens"])
    return dataclasses.replace(merging, **{key: jnp.asarray(tokens) for key, tokens in published.items()})


@pytest.mark.parametrize("name", RUNS)
def test_golden_values(golden: Any, name: str) -> None:
    arrays, images = golden.arrays, golden.arrays["images_u8"]
    model, params, merging = plain_vggt(LogVGGT(golden.config), len(images)), golden.variables, _merging(golden, name)
    windows, size = model.windows, images.shape[1:3]

    @jax.jit
    def run_model(params, images, merging):
        patches, mask = windows.encode(params, images[None]), jnp.ones((1, len(images)), bool)
        tokens, _ = run(
            windows.aggregator,
            params["params"]["aggregator"],
            patches,
            None,
            mask[:, 0],
            merging,
            grid=windows.grid(size),
        )
        out = windows.decode_dense(params, tokens, mask, size)
        return tokens.key[0], model.refinement.decode_cameras(params, out.camera_tokens, mask)[0], out

    key, poses, out = jax.device_get(run_model(params, images, merging))
    for i, layer in enumerate(golden.sizes["layers"]):
        expected = arrays[f"{name}_tokens_{layer:02d}"]
        found = key[i] if expected.shape[1] == key.shape[2] else key[i][:, arrays["token_index"]]
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5, err_msg=f"block {layer}")
    np.testing.assert_allclose(poses.swapaxes(0, 1), arrays[f"{name}_pose_enc"], rtol=0, atol=5e-6)
    every = 1 if name == "default" else 2
    for found, expected in ((out.depth, "depth"), (out.depth_confidence, "depth_conf")):
        np.testing.assert_allclose(
            found[0, :, ::every, ::every], arrays[f"{name}_{expected}"], rtol=1e-5, atol=2e-5, err_msg=expected
        )


@pytest.mark.parametrize("index", [0, 1])
def test_golden_steps_of_a_layer(golden: Any, index: int) -> None:
    """Assignments exactly; merged queries, keys and values; what the attention's result is spread to."""
    layer = golden.sizes["detail_layers"][index]
    arrays, merging = golden.arrays, _merging(golden, "default")
    assert merging is not None

    def stored(key: str) -> np.ndarray:
        return arrays[f"default_l{layer:02d}_{key}"]

    def split(x: np.ndarray) -> jax.Array:
        return jnp.asarray(x.reshape(1, len(x), golden.config.aggregator.num_heads, -1))

    place, cosine = merging.nearest(jnp.asarray(stored("metric")))
    free = ~np.isin(arrays["source_tokens"], arrays["protected_tokens"])
    np.testing.assert_array_equal(place, arrays["default_best_destination"][layer][free])
    np.testing.assert_allclose(cosine, arrays["default_best_similarity"][layer][free], rtol=0, atol=2e-6)

    def attention(query: jax.Array, keys: Keys) -> jax.Array:
        for found, key in ((query, "q"), (keys.key, "k"), (keys.value, "v")):
            expected = stored(f"{key}_merged")
            np.testing.assert_allclose(found[0].reshape(expected.shape), expected, rtol=0, atol=2e-6)
        return split(stored("attn_projected"))

    own = OwnTokens(
        jnp.asarray(stored("metric")[None]),
        split(stored("q_in")),
        Keys(split(stored("k_in")), split(stored("v_in")), None),
    )
    taken, _ = merging.attend(own, attention, lambda tokens: own.keys)
    expected = stored("attn_unmerged")
    np.testing.assert_array_equal(taken[0].reshape(expected.shape), expected)


def _predicted(session: OfflineSession, images: np.ndarray) -> list[np.ndarray]:
    results = [*session.push(images), *session.close()]
    return [np.stack([getattr(result, name) for result in results]) for name in ("depth", "confidence")] + [
        session.cameras().pose_encoding
    ]


def test_nothing_merged_is_plain_vggt(small_config: ModelConfig, small_variables: dict) -> None:
    model = LogVGGT(small_config)
    plain = _predicted(OfflineSession(model, small_variables, OfflineSettings()), IMAGES)
    none = _predicted(MergedSession(model, small_variables, MergedSettings(ratio=0)), IMAGES)
    merged = _predicted(MergedSession(model, small_variables, MergedSettings()), IMAGES)
    for expected, found, other in zip(plain, none, merged, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
        assert np.abs(other - expected).max() > 1e-3


def test_one_frame_has_nothing_to_merge(small_config: ModelConfig, small_variables: dict) -> None:
    model = LogVGGT(small_config)
    plain = _predicted(OfflineSession(model, small_variables, OfflineSettings()), IMAGES[:1])
    merged = _predicted(MergedSession(model, small_variables, MergedSettings()), IMAGES[:1])
    for expected, found in zip(plain, merged, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("grid", [(4, 6), (5, 7), (2, 3), (1, 4)])
def test_every_token_is_a_source_a_destination_or_protected(grid: tuple[int, int]) -> None:
    frames, special = 7, 5
    merging = merging_of(frames, grid, special, ratio=0.9, protected=0.1, similarity="float32")
    assert merging is not None
    per_frame = special + grid[0] * grid[1]
    total = frames * per_frame
    sources, destinations = set(merging.sources.tolist()), set(merging.destinations.tolist())
    protected = merging.protected.tolist()
    assert not sources & (destinations | set(protected))
    assert sources | destinations | set(protected) == set(range(total))
    assert len(protected) == total // 10 and len(set(np.diff(protected))) == 1
    assert set(range(per_frame)) <= destinations
    assert all(token % per_frame >= special for token in sources)
    # One patch of every whole cell, in every frame after the first.
    assert len(destinations) == per_frame + (frames - 1) * (special + (grid[0] // 2) * (grid[1] // 2))
    assert merging.merged == len(sources)


def test_the_least_similar_sources_attend_on_their_own() -> None:
    """Two tokens are merged: those that have a twin among the destinations. All others see themselves."""
    merging = merging_of(3, (2, 2), 1, ratio=2.2 / 15, protected=0, similarity="float32")
    assert merging is not None and merging.merged == 2
    x = np.random.default_rng(1).standard_normal((1, 15, 4)).astype(np.float32)
    twins = np.asarray(merging.sources)[[1, 4]], np.asarray(merging.destinations)[[0, 3]]
    x[0, twins[0]] = x[0, twins[1]]
    split = jnp.asarray(x)[:, :, None]
    own = OwnTokens(jnp.asarray(x), split, Keys(split, split, None))

    def attention(query: jax.Array, keys: Keys) -> jax.Array:
        assert query.shape[1] == keys.key.shape[1] == 13
        return query

    taken, _ = merging.attend(own, attention, lambda tokens: own.keys)
    np.testing.assert_allclose(taken[:, :, 0], x, rtol=1e-6)


def test_similarities_in_blocks_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    merging = merging_of(5, (4, 5), 5, ratio=0.9, protected=0.1, similarity="float32")
    assert merging is not None
    features = jnp.asarray(np.random.default_rng(2).standard_normal((125, 8)), jnp.float32)
    whole = merging.nearest(features)
    monkeypatch.setattr(module, "_BLOCK_SIMILARITIES", 7 * len(merging.destinations))
    for found, expected in zip(merging.nearest(features), whole, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_merging_costs_less(small_config: ModelConfig) -> None:
    model, frames = LogVGGT(small_config), 40
    plain = offline_program(model, (84, 126), OfflineSettings(), frames).flops
    assert merged_program(model, (84, 126), MergedSettings(), frames).flops < 0.7 * plain


@pytest.mark.parametrize(
    ("field", "value"), [("ratio", 1.5), ("ratio", -0.1), ("protected", 2), ("similarity", "int8"), ("max_frames", 0)]
)
def test_settings_that_mean_nothing_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"MergedSettings.{field} must"):
        MergedSettings(**{field: value})
