"""Products in eight bits: near the float ones, in the places where they should be and nowhere else."""

from __future__ import annotations

import dataclasses
import re
import sys
from collections import Counter
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.doctor.subject import random_variables
from logvggt_jax.errors import MissingPackage
from logvggt_jax.model.low_precision import PRECISIONS, check_precision, in_low_precision, precision_of, product
from logvggt_jax.model.parameters import in_compute_type, stack_layers

pytest.importorskip("qwix", reason="qwix is not installed (extra `lowprecision`)")

# Of a program's text: the types of both factors and of the product.
_PRODUCT = re.compile(r"dot_general.*\(tensor<[\dx]*x(\w+)>, tensor<[\dx]*x(\w+)>\) -> tensor<[\dx]*x(\w+)>")
# Products of a block: query, key_value, output, fc1, fc2.
_BLOCK = 5


@pytest.fixture(scope="module")
def model(small_config: ModelConfig) -> LogVGGT:
    return LogVGGT(dataclasses.replace(small_config, dtype="bfloat16", attention="xla"))


@pytest.fixture(scope="module")
def variables(model: LogVGGT) -> dict[str, Any]:
    return random_variables(model, scale=0.1)


_in_compute_type = jax.jit(in_compute_type, static_argnums=1)


def leaves(tree: Any) -> dict[str, Any]:
    found = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in found}


def step_inputs(model: LogVGGT, variables: dict[str, Any]) -> tuple[Any, np.ndarray]:
    frames = np.random.default_rng(0).integers(0, 256, (1, 2, 28, 42, 3), np.uint8)
    state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(model.start, variables, frames))
    return state, frames


@pytest.mark.parametrize(("precision", "bound"), [("int8", 0.01), ("fp8", 0.04)])
def test_every_token_and_channel_has_its_own_scale(precision: str, bound: float) -> None:
    random = np.random.default_rng(0)
    # Tokens and channels of very different sizes: one scale for all would leave nothing of the small ones.
    tokens = random.standard_normal((2, 3, 256)).astype(np.float32) * np.float32([[[1e-3], [1.0], [1e3]]])
    kernel = random.standard_normal((256, 5)).astype(np.float32) * np.float32([1e-4, 1e-2, 1.0, 1e2, 1e4])
    coded = in_low_precision({"params": {"encoder": {"block_0": {"kernel": kernel}}}}, precision)
    codes = coded["params"]["encoder"]["block_0"]
    found = np.asarray(product(jnp.asarray(tokens), codes["codes"], codes["scale"]))
    typical = np.linalg.norm(tokens, axis=-1)[..., None] * np.linalg.norm(kernel, axis=0) / 256**0.5
    assert found.dtype == np.float32
    assert (np.abs(found - tokens @ kernel) / typical).max() < 3 * bound
    # It is not the float product: the codes are what is multiplied.
    assert (np.abs(found - tokens @ kernel) / typical).mean() > bound / 10


def test_the_kernels_of_blocks_are_coded_and_nothing_else(model: LogVGGT, variables: dict[str, Any]) -> None:
    coded = leaves(in_compute_type(in_low_precision(variables, "int8"), model.config))
    plain = leaves(_in_compute_type(variables, model.config))
    given = leaves(variables)
    blocks = {name for name in given if name.endswith("/kernel") and "block_" in name and "head" not in name}
    depth = model.config.encoder.depth + 2 * model.config.aggregator.depth
    assert len(blocks) == _BLOCK * depth
    assert {name for name, leaf in coded.items() if leaf.dtype == jnp.int8} == {
        name.replace("/kernel", "/codes") for name in blocks
    }
    for name in blocks:
        kernel = np.asarray(given[name])
        scale = coded[name.replace("/kernel", "/scale")]
        assert scale.dtype == jnp.float32 and scale.shape == (1, kernel.shape[1])
        again = np.asarray(coded[name.replace("/kernel", "/codes")]) * np.asarray(scale)
        assert (np.abs(again - kernel) <= np.asarray(scale) * 0.501).all()
    assert all(coded[name].dtype == plain[name].dtype for name in plain.keys() & coded.keys() if "block_" not in name)
    assert given.keys() - coded.keys() == blocks


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_step_multiplies_codes_in_every_block(model: LogVGGT, variables: dict[str, Any], precision: str) -> None:
    coded = in_compute_type(in_low_precision(variables, precision), model.config)
    inputs = step_inputs(model, coded)
    factor, result = {"int8": ("i8", "i32"), "fp8": ("f8E4M3FN", "f32")}[precision]

    def products(variables: dict[str, Any]) -> Counter[tuple[str, ...]]:
        lowered = jax.jit(model.step).trace(variables, *inputs).lower(lowering_platforms=("cuda",))
        return Counter(_PRODUCT.findall(lowered.as_text()))

    plain, found = products(_in_compute_type(variables, model.config)), products(coded)
    # A block of each kind is in the text once and called for every layer; keys of the cache are one more product.
    expected = 3 * _BLOCK + 1
    assert found[factor, factor, result] == expected
    # Those of queries and of keys are one in each kind of block where they are not coded.
    assert sum(found.values()) == sum(plain.values()) + 3
    assert products(jax.eval_shape(stack_layers, coded)) == found


def test_a_step_is_near_the_one_in_bfloat16(model: LogVGGT, variables: dict[str, Any]) -> None:
    step = jax.jit(model.step, donate_argnums=1)

    def tokens(variables: dict[str, Any]) -> np.ndarray:
        variables = in_compute_type(variables, model.config)
        state, frames = step_inputs(model, variables)
        # The second window reads what the first one has left in the cache.
        state, _ = step(variables, state, frames)
        return np.asarray(step(variables, state, frames[:, ::-1])[1].camera_tokens, np.float32)

    plain, found = tokens(variables), tokens(in_low_precision(variables, "int8"))
    error = np.linalg.norm(found - plain) / np.linalg.norm(plain)
    assert 0.0 < error < 0.03


@pytest.mark.parametrize("precision", PRECISIONS)
def test_parameters_say_their_precision(variables: dict[str, Any], precision: str) -> None:
    assert precision_of(variables) is None
    encoder = {"params": {"encoder": variables["params"]["encoder"]}}
    assert precision_of(in_low_precision(encoder, precision)) == precision


@pytest.mark.parametrize(
    ("device", "fast"),
    [
        (SimpleNamespace(platform="cpu", device_kind="cpu"), ""),
        (SimpleNamespace(platform="gpu", device_kind="H100", compute_capability="9.0"), "int8 fp8"),
        (SimpleNamespace(platform="gpu", device_kind="B200", compute_capability="10.0"), "int8 fp8"),
        (SimpleNamespace(platform="gpu", device_kind="A100", compute_capability="8.0"), "int8"),
        (SimpleNamespace(platform="gpu", device_kind="V100", compute_capability="7.0"), ""),
        (SimpleNamespace(platform="gpu", device_kind="MI300X", compute_capability="gfx942"), "int8 fp8"),
        (SimpleNamespace(platform="tpu", device_kind="TPU v4"), ""),
        (SimpleNamespace(platform="tpu", device_kind="TPU v5 lite"), "int8"),
        (SimpleNamespace(platform="tpu", device_kind="TPU v6 lite"), "int8"),
        (SimpleNamespace(platform="tpu", device_kind="TPU7x"), "fp8"),
    ],
    ids=lambda device: getattr(device, "device_kind", None),
)
def test_a_device_that_gains_nothing_is_named(device: Any, fast: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "devices", lambda: [device])
    for precision in PRECISIONS:
        note = check_precision(precision)
        assert (note is None) == (precision in fast.split())
        assert note is None or (precision in note and device.device_kind in note)


def test_without_the_library_one_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "qwix", None)
    with pytest.raises(MissingPackage, match=r"qwix.*not installed.*logvggt-jax\[lowprecision\]"):
        check_precision("int8")
