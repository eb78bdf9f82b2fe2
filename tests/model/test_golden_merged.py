"""Merged tokens give FastVGGT's numbers."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_methods import POSES, TOKENS, Golden, assert_depth

from logvggt_jax import LogVGGT
from logvggt_jax.model.memory import Keys, OwnTokens
from logvggt_jax.model.merging import TokenMerging
from logvggt_jax.model.parameters import run
from logvggt_jax.streaming import MergedSettings
from logvggt_jax.streaming.merged import merging_for
from logvggt_jax.streaming.offline import plain_vggt

RUNS = ("default", "exact", "low", "zero")


@pytest.fixture(scope="module")
def golden(golden_dir: Path) -> Golden:
    return golden_methods.load(golden_dir, "merged")


def _merging(golden: Golden, name: str) -> TokenMerging | None:
    """A golden run's merging with the published order of destinations, which decides between equally similar ones."""
    images, sizes = golden.arrays["images_u8"], golden.settings
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


@pytest.mark.parametrize(
    "name", [name if name == "default" else pytest.param(name, marks=pytest.mark.slow) for name in RUNS]
)
def test_golden_values(golden: Golden, name: str) -> None:
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
    for i, layer in enumerate(golden.settings["layers"]):
        expected = arrays[f"{name}_tokens_{layer:02d}"]
        found = key[i] if expected.shape[1] == key.shape[2] else key[i][:, arrays["token_index"]]
        np.testing.assert_allclose(found, expected, rtol=0, atol=TOKENS, err_msg=f"block {layer}")
    np.testing.assert_allclose(poses.swapaxes(0, 1), arrays[f"{name}_pose_enc"], rtol=0, atol=POSES)
    every = 1 if name == "default" else 2
    for found, expected in ((out.depth, "depth"), (out.depth_confidence, "depth_conf")):
        assert_depth(found[0, :, ::every, ::every], arrays[f"{name}_{expected}"])


@pytest.mark.parametrize("index", [0, 1])
def test_golden_steps_of_a_layer(golden: Golden, index: int) -> None:
    """Assignments exactly; merged queries, keys and values; what the attention's result is spread to."""
    layer = golden.settings["detail_layers"][index]
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
