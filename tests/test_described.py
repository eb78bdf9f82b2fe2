"""Devices that are described alone: which there are, and what is compiled for them."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from jax._src.cudnn import fused_attention_stablehlo

from logvggt_jax.described import (
    attention_kernels,
    cudnn_by_description,
    described_bytes,
    described_devices,
    gpu_compiler_installed,
)
from logvggt_jax.errors import InputError, MissingPackage


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What the compilers were asked for; they are all installed, and give two devices."""
    from jax.experimental import topologies

    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(
        topologies,
        "get_topology_desc",
        lambda **description: calls.append(description) or SimpleNamespace(devices=("first", "second")),
    )
    return calls


def test_slices_and_gpus_are_described_by_their_compilers(asked: list[dict[str, Any]]) -> None:
    assert described_devices("v5p:2x2x4") == ["first", "second"]
    assert asked.pop() == {"topology_name": "v5p:2x2x4", "platform": "tpu"}
    for name, topology in (("h100", "1x1x1"), ("h100:", "1x1x1"), ("H20:16", "1x1x16")):
        described_devices(name)
        (call,) = asked
        assert (call["platform"], call["topology"]) == ("cuda", topology)
        assert call["target_config"].count("{") == call["target_config"].count("}") > 0
        asked.clear()


@pytest.mark.parametrize("name", ["h100:0", "h100:many", "h100:-1"])
def test_gpus_are_counted(asked: list[dict[str, Any]], name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: expected a number of GPUs .* h100:16"):
        described_devices(name)
    assert not asked


@pytest.mark.parametrize(
    ("name", "message"),
    [("v9:1x1", "v9:1x1: no such devices, expected .*v5p:2x2x4.*h100:16 .no such"), ("h100", "JAX_PLATFORMS=cpu .no")],
)
def test_what_cannot_be_described_is_one_line(
    asked: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, name: str, message: str
) -> None:
    from jax.experimental import topologies

    def refuse(**_: object) -> None:
        raise RuntimeError("no such\ntopology")

    monkeypatch.setattr(topologies, "get_topology_desc", refuse)
    with pytest.raises(InputError, match=message) as error:
        described_devices(name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "package"),
    [("v5p:2x2x4", "pip install libtpu"), ("a100:4", "h20, h100, h200"), ("h100", r"logvggt-jax\[cuda\]")],
)
def test_a_compiler_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackage, match=package):
        described_devices(name)


def test_memory_is_what_jax_shares_out() -> None:
    device: Any = SimpleNamespace(device_kind="NVIDIA H100 80GB HBM3")
    assert described_bytes(device) == 0.75 * 81_559 * 2**20
    assert described_bytes(jax.devices()[0]) is None


def test_cudnn_is_lowered_in_the_context_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fused_attention_stablehlo.check_cudnn_version
    tokens = jax.ShapeDtypeStruct((1, 64, 2, 64), jnp.bfloat16)

    def attend(x: jax.Array) -> jax.Array:
        return jax.nn.dot_product_attention(x, x, x, implementation="cudnn")

    gpu: Any = SimpleNamespace(platform="gpu", device_kind="NVIDIA H100 80GB HBM3")
    with attention_kernels(gpu) as attention:
        text = jax.jit(attend).trace(tokens).lower(lowering_platforms=("cuda",)).as_text()
    assert attention == "cudnn" and "__cudnn$fmhaSoftmax" in text
    assert fused_attention_stablehlo.check_cudnn_version is before
    # A GPU that is there is asked itself.
    monkeypatch.setattr(jax, "devices", lambda: [gpu])
    with attention_kernels(gpu) as attention:
        assert attention == "auto" and fused_attention_stablehlo.check_cudnn_version is before
    monkeypatch.delattr(fused_attention_stablehlo, "check_compute_capability")
    with pytest.raises(InputError, match="cannot lower"), cudnn_by_description():
        pass
    assert fused_attention_stablehlo.check_cudnn_version is before


@pytest.mark.slow
@pytest.mark.skipif(not gpu_compiler_installed(), reason="needs the compiler that JAX for CUDA brings, and no GPU")
def test_a_program_is_compiled_for_a_gpu_that_is_not_there() -> None:
    (device,) = described_devices("h100")
    assert device.platform == "gpu"
    sharding = jax.sharding.SingleDeviceSharding(device)
    factor = jax.ShapeDtypeStruct((256, 256), jnp.bfloat16, sharding=sharding)
    compiled = jax.jit(lambda x: x @ x).lower(factor).compile()
    assert compiled.memory_analysis().argument_size_in_bytes == 2 * 256**2
