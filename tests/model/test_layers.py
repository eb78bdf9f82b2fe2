"""Parts of the transformer block in 16 bits: what they round, and what a stream's parameters look like."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.described import cudnn_by_description
from logvggt_jax.model.layers import MLP, _gelu, dense, sums_of
from logvggt_jax.model.parameters import in_compute_type, stack_layers
from logvggt_jax.operations import count_flops

FRAMES = jax.ShapeDtypeStruct((1, 2, 28, 42, 3), jnp.uint8)


_in_compute_type = jax.jit(in_compute_type, static_argnums=1)


def exact(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x Φ(x) and its slope, float64."""
    below = 0.5 * (1 + erf(x * math.sqrt(0.5)))
    return x * below, below + x * np.exp(-x * x / 2) / math.sqrt(2 * math.pi)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_gelu_is_exact_before_it_is_rounded(dtype: str) -> None:
    x = np.concatenate([np.linspace(-12, 12, 20_001), [0.0, -0.0]]).astype(np.float32)
    value, slope = exact(x.astype(np.float64))

    @jax.jit
    def gelu(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _gelu(x, dtype), jax.vmap(jax.grad(lambda x: _gelu(x, dtype)))(x)

    found, found_slope = jax.device_get(gelu(x))
    assert np.abs(found - value).max() < 1e-6
    assert np.abs(found_slope - slope).max() < 1e-6
    # A sixteenth of what bfloat16 rounds off, where that is more than nothing at all.
    tail = (x > -4) & (x < 0)
    assert (np.abs(found - value)[tail] < 2**-8 / 16 * np.abs(value[tail]) + 1e-6).all()


def test_biases_are_added_to_sums_in_16_bits_without_another_rounding() -> None:
    layer = dense(4, "layer", "bfloat16", sums="bfloat16")
    x = np.ones((1, 8), jnp.bfloat16)
    params = {"kernel": np.full((8, 4), 2.0, np.float32), "bias": np.full(4, 2.0**-7, np.float32)}
    found = np.asarray(jax.jit(layer.apply)({"params": params}, x))
    # 16 + 1/128 has more digits than bfloat16.
    assert found.dtype == jnp.float32 and (found == 16 + 2.0**-7).all()
    params["bias"] = np.arange(4, dtype=np.float32)
    some = functools.partial(layer.apply, columns=slice(1, None), cuts=(2,))
    first, second = jax.jit(some)({"params": params}, x)
    np.testing.assert_array_equal(first, [[17.0, 18.0]])
    np.testing.assert_array_equal(second, [[19.0]])


def test_float16_hands_on_what_it_cannot_hold() -> None:
    layer = dense(1, "layer", "float16", sums=sums_of("float16"))
    params = {"kernel": np.full((4, 1), 2.0**15, np.float32), "bias": np.zeros(1, np.float32)}
    assert np.asarray(jax.jit(layer.apply)({"params": params}, np.ones((1, 4), np.float32))) == 2.0**17
    assert sums_of("bfloat16") == "bfloat16"


def test_operations_are_the_same_in_the_form_of_streams(model: LogVGGT, small_variables: Any) -> None:
    """Queries, keys and values of a block's own tokens are one product, keys of stored ones no more than theirs."""
    plain = LogVGGT(dataclasses.replace(model.config, attention="xla"))
    state = jax.eval_shape(plain.start, small_variables, FRAMES)
    given, streamed = (
        count_flops(plain.step, variables, state, FRAMES)
        for variables in (small_variables, _in_compute_type(small_variables, model.config))
    )
    assert streamed == given


def test_wide_values_are_16_bits_in_memory() -> None:
    """Of the values between an MLP's products none is both wide and float32 when the first product hands it out."""
    mlp = MLP(64, 16, "bfloat16")
    x = jax.ShapeDtypeStruct((8, 16), jnp.float32)
    text = jax.jit(mlp.apply).lower(jax.eval_shape(mlp.init, jax.random.key(0), x), x).as_text()
    products = re.findall(r"dot_general.*-> tensor<(8x\d+x\w+)>", text)
    assert products == ["8x64xbf16", "8x16xbf16"]


@pytest.fixture
def model(small_config: ModelConfig) -> LogVGGT:
    return LogVGGT(dataclasses.replace(small_config, dtype="bfloat16"))


def test_streams_have_queries_keys_and_values_side_by_side(model: LogVGGT, small_variables: Any) -> None:
    given = small_variables["params"]["aggregator"]["global_block_0"]["attention"]
    streamed = _in_compute_type(small_variables, model.config)
    found = streamed["params"]["aggregator"]["global_block_0"]["attention"]
    assert found.keys() == given.keys() - {"query", "key_value"} | {"query_key_value"}
    for name in ("kernel", "bias"):
        both = np.concatenate([given["query"][name], given["key_value"][name]], axis=-1)
        np.testing.assert_array_equal(found["query_key_value"][name], both.astype(jnp.bfloat16))
    # GCCR's queries and keys are of different tokens; the camera head computes in float32.
    assert (
        "query" in streamed["params"]["gccr"] and "query" in streamed["params"]["camera_head"]["trunk_0"]["attention"]
    )
    again = in_compute_type(streamed, model.config)
    jax.tree.map(np.testing.assert_array_equal, again, streamed)
    stacked, expected = jax.jit(
        lambda given, streamed: (_in_compute_type(stack_layers(given), model.config), stack_layers(streamed))
    )(small_variables, streamed)
    jax.tree.map(np.testing.assert_array_equal, stacked, expected)


def test_a_step_of_real_frames_selects_and_sorts_no_keys(model: LogVGGT, small_variables: Any) -> None:
    model = LogVGGT(dataclasses.replace(model.config, attention="cudnn"))
    variables = _in_compute_type(small_variables, model.config)

    def lowered(frame_mask: Any = None, masks: Any = None) -> str:
        held = None if masks is None else jax.ShapeDtypeStruct((1, 2, 28, 42), bool)
        state = jax.eval_shape(model.start, variables, FRAMES, None, held)
        traced = jax.jit(model.step).trace(variables, state, FRAMES, frame_mask, masks)
        return traced.lower(lowering_platforms=("cuda",)).as_text()

    some_frames, some_pixels = jax.ShapeDtypeStruct((1, 2), bool), jax.ShapeDtypeStruct((1, 2, 28, 42), bool)
    with cudnn_by_description():
        all_real, padded, masked = lowered(), lowered(some_frames), lowered(some_frames, some_pixels)
    # [batch, keys of window and cache, heads, head_dim] of 11 tokens a frame.
    keys = "1x66x2x16xbf16"
    assert re.search(rf"stablehlo.concatenate.*{keys}", all_real), "keys of the cache come behind the window's own"
    assert not re.search(rf"stablehlo.select.*{keys}", all_real) and "stablehlo.sort" not in all_real
    assert re.search(rf"stablehlo.select.*{keys}", padded), "padding may end the window"
    assert "stablehlo.sort" in masked, "keys that count go first"
