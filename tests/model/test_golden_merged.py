"""Merged tokens give FastVGGT's numbers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import golden_methods
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from golden_methods import POSES, TOKENS, Golden, assert_depth
from pieces import in_pieces

from logvggt_jax import LogVGGT
from logvggt_jax.model import merging as merging_module
from logvggt_jax.model.memory import Attend, Keys, OwnTokens, Project
from logvggt_jax.model.merging import TokenMerging
from logvggt_jax.streaming import MergedSettings
from logvggt_jax.streaming.merged import merging_for
from logvggt_jax.streaming.offline import plain_vggt

RUNS = ("default", "exact", "low", "zero")
SIMILARITIES = 2e-6


@struct.dataclass
class Recorded(TokenMerging):
    """A merging that notes what every layer does.

    Attributes:
      layer: number of the block at hand; no static field, so that one program serves all layers.
      notes: static, a function of arrays by name, the layer among them.
    """

    layer: Any = -1
    notes: Any = struct.field(pytree_node=False, default=None)

    def at(self, layer: int) -> Recorded:
        return dataclasses.replace(self, layer=jnp.int32(layer))

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, TokenMerging]:
        place, cosine = self.nearest(own.normed[0])
        kept, merged, _ = self._assignment(own.normed[0])

        def noted(query: jax.Array, keys: Keys) -> jax.Array:
            arrays = {
                "layer": self.layer,
                "place": place,
                "cosine": cosine,
                "kept": kept,
                "merged": merged,
                "normed": own.normed[0],
            }
            rows = {"q": query, "k": keys.key, "v": keys.value}
            arrays |= {f"{name}_merged": x[0].reshape(x.shape[1], -1) for name, x in rows.items()}
            jax.debug.callback(self.notes, **arrays)
            return attention(query, keys)

        return super().attend(own, noted, project)


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
    return dataclasses.replace(merging, **{key: tokens.astype(np.int32) for key, tokens in published.items()})


@jax.jit
def _steps(merging: TokenMerging, own: OwnTokens, result: jax.Array) -> Any:
    """What `nearest` gives, the rows of queries, keys and values that attention is given, and what `result`, the
    attention's, is spread to."""
    given = []

    def attention(query: jax.Array, keys: Keys) -> jax.Array:
        given.append((query, keys.key, keys.value))
        return result

    taken, _ = merging.attend(own, attention, lambda _: own.keys)
    return merging.nearest(own.normed[0]), given[0], taken


@pytest.mark.parametrize(
    "name", [name if name == "default" else pytest.param(name, marks=pytest.mark.slow) for name in RUNS]
)
def test_golden_values(golden: Golden, name: str) -> None:
    arrays, images = golden.arrays, golden.arrays["images_u8"]
    model, params, plain = plain_vggt(LogVGGT(golden.config), len(images)), golden.variables, _merging(golden, name)
    windows, size = model.windows, images.shape[1:3]

    @in_pieces
    def run_model(params, images, merging):
        patches, mask = windows.encode(params, images[None]), jnp.ones((1, len(images)), bool)
        aggregator = {"params": params["params"]["aggregator"]}
        tokens, _ = windows.aggregator.apply(aggregator, patches, None, mask[:, 0], merging, grid=windows.grid(size))
        out = windows.decode_dense(params, tokens, mask, size)
        return tokens.key[0], model.refinement.decode_cameras(params, out.camera_tokens, mask)[0], out

    notes: dict[int, dict[str, np.ndarray]] = {}
    merging = None
    if plain is not None:
        fields = {field.name: getattr(plain, field.name) for field in dataclasses.fields(plain)}
        merging = Recorded(**fields, notes=lambda layer, **arrays: notes.update({int(layer): arrays}))
    key, poses, out = jax.device_get(run_model(params, images, merging))
    jax.effects_barrier()
    if plain is not None:
        _assert_assignments(golden, name, plain, jax.tree.map(np.asarray, notes))
    for i, layer in enumerate(golden.settings["layers"]):
        expected = arrays[f"{name}_tokens_{layer:02d}"]
        found = key[i] if expected.shape[1] == key.shape[2] else key[i][:, arrays["token_index"]]
        np.testing.assert_allclose(found, expected, rtol=0, atol=TOKENS, err_msg=f"block {layer}")
    np.testing.assert_allclose(poses.swapaxes(0, 1), arrays[f"{name}_pose_enc"], rtol=0, atol=POSES)
    every = 1 if name == "default" else 2
    for found, expected in ((out.depth, "depth"), (out.depth_confidence, "depth_conf")):
        assert_depth(found[0, :, ::every, ::every], arrays[f"{name}_{expected}"])


def _assert_assignments(
    golden: Golden, name: str, merging: TokenMerging, notes: dict[int, dict[str, np.ndarray]]
) -> None:
    """Each source's destination, its cosine, what is merged and how far the second best lies, in all layers; merged
    queries, keys and values of some, and what these layers spread to all tokens."""
    arrays, heads = golden.arrays, golden.config.aggregator.num_heads
    free = ~np.isin(arrays["source_tokens"], arrays["protected_tokens"])
    assert sorted(notes) == list(range(golden.config.aggregator.depth))
    for layer, note in notes.items():
        np.testing.assert_array_equal(note["place"], arrays[f"{name}_best_destination"][layer][free], str(layer))
        cosines = arrays[f"{name}_best_similarity"][layer][free]
        # In bfloat16 a cosine is one of few: the last digit of what was rounded decides between neighbours.
        tolerance = SIMILARITIES if merging.similarity == "float32" else 2**-8
        np.testing.assert_allclose(note["cosine"], cosines, rtol=0, atol=tolerance)
        merged = arrays["source_tokens"][arrays[f"{name}_source_is_merged"][layer].astype(bool)]
        assert set(note["merged"]) == set(merged)
        unit = note["normed"] / np.linalg.norm(note["normed"].astype(np.float64), axis=1, keepdims=True)
        two = np.sort(unit[arrays["source_tokens"]] @ unit[arrays["destination_tokens"]].T, axis=1)[:, -2:]
        gap = arrays[f"{name}_similarity_gap"][layer]
        np.testing.assert_allclose((two[:, 1] - two[:, 0])[free], gap[free], rtol=0, atol=2 * SIMILARITIES)
    if f"{name}_l{golden.settings['detail_layers'][0]:02d}_q_merged" not in arrays:
        return
    for layer in golden.settings["detail_layers"]:
        note, stem = notes[layer], f"{name}_l{layer:02d}"
        np.testing.assert_array_equal(note["kept"], arrays[f"{stem}_unmerged_sources"])
        for rows in ("q_merged", "k_merged", "v_merged"):
            np.testing.assert_allclose(note[rows], arrays[f"{stem}_{rows}"], rtol=0, atol=TOKENS)
        given = arrays[f"{stem}_attn_projected"]
        nothing = np.zeros((1, len(note["normed"]), heads, given.shape[1] // heads), np.float32)
        own = OwnTokens(note["normed"][None], nothing, Keys(nothing, nothing, None))
        *_, spread = _steps(merging, own, given.reshape(1, len(given), heads, -1))
        expected = arrays[f"{stem}_attn_unmerged"]
        np.testing.assert_array_equal(np.asarray(spread).reshape(expected.shape), expected)


def test_the_draws_are_the_originals(golden: Golden) -> None:
    """Of each whole 2 x 2 cell the patch that the generator chose, in every frame but the first."""
    draws, images = golden.arrays["rand_draws"], golden.arrays["images_u8"]
    chosen = merging_module._chosen_of_cells(len(images) - 1, (images.shape[1] // 14, images.shape[2] // 14))
    rows, columns = draws.shape[1:]
    cells = chosen.reshape(-1, rows, 2, columns, 2).transpose(0, 1, 3, 2, 4).reshape(*draws.shape, 4)
    np.testing.assert_array_equal(cells.argmax(-1), draws)
    assert (cells.sum(-1) == 1).all()


@pytest.mark.parametrize("index", [0, 1])
def test_golden_steps_of_a_layer(golden: Golden, index: int) -> None:
    """Assignments exactly; merged queries, keys and values; what the attention's result is spread to."""
    layer = golden.settings["detail_layers"][index]
    arrays, merging = golden.arrays, _merging(golden, "default")
    assert merging is not None

    def stored(key: str) -> np.ndarray:
        return arrays[f"default_l{layer:02d}_{key}"]

    def split(x: np.ndarray) -> np.ndarray:
        return x.reshape(1, len(x), golden.config.aggregator.num_heads, -1)

    keys = Keys(split(stored("k_in")), split(stored("v_in")), None)
    own = OwnTokens(stored("metric")[None], split(stored("q_in")), keys)
    (place, cosine), given, taken = jax.device_get(_steps(merging, own, split(stored("attn_projected"))))
    free = ~np.isin(arrays["source_tokens"], arrays["protected_tokens"])
    np.testing.assert_array_equal(place, arrays["default_best_destination"][layer][free])
    np.testing.assert_allclose(cosine, arrays["default_best_similarity"][layer][free], rtol=0, atol=SIMILARITIES)

    for found, key in zip(given, "qkv", strict=True):
        expected = stored(f"{key}_merged")
        np.testing.assert_allclose(found[0].reshape(expected.shape), expected, rtol=0, atol=2e-6)
    expected = stored("attn_unmerged")
    np.testing.assert_array_equal(taken[0].reshape(expected.shape), expected)
