"""Accelerators that are described alone: programs are compiled for them where they are not."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import os
from collections.abc import Iterator
from typing import Any

import jax

from logvggt_jax.errors import InputError, MissingPackage, install_line, one_line


@dataclasses.dataclass(frozen=True)
class _GPU:
    """What XLA asks of a GPU of NVIDIA's Hopper generation, by its data sheet."""

    kind: str
    multiprocessors: int
    memory: int  # bytes, as nvidia-smi gives them
    bandwidth: float  # bytes a second
    level_2_cache: int  # bytes


_GPUS = {
    "h20": _GPU("NVIDIA H20", 78, 97_871 * 2**20, 4.0e12, 60 * 2**20),
    "h100": _GPU("NVIDIA H100 80GB HBM3", 132, 81_559 * 2**20, 3.35e12, 50 * 2**20),
    "h200": _GPU("NVIDIA H200", 132, 143_771 * 2**20, 4.8e12, 60 * 2**20),
}
# Of a GPU's memory; what JAX takes unless told otherwise.
_SHARE = 0.75
_CUDNN = 91000
_CUDA_VERSIONS = (13, 12)
_TARGET = """
gpu_device_info {{
  name: "{kind}"
  core_count: {multiprocessors}
  device_memory_size: {memory}
  memory_bandwidth: {bandwidth:.0f}
  l2_cache_size: {level_2_cache}
  cuda_compute_capability {{ major: 9 feature_extension: ACCELERATED_FEATURES }}
  clock_rate_ghz: 1.98
  fpus_per_core: 128
  threads_per_warp: 32
  threads_per_block_limit: 1024
  threads_per_core_limit: 2048
  registers_per_block_limit: 65536
  registers_per_core_limit: 65536
  shared_memory_per_block: 49152
  shared_memory_per_block_optin: 232448
  shared_memory_per_core: 233472
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  driver_version: "13.0.0"
  runtime_version: "13.0.0"
  compile_time_toolkit_version: "13.0.0"
  dnn_version: "9.10.0"
}}
platform_name: "CUDA"
dnn_version_info {{ major: 9 minor: 10 }}
runtime_version {{ major: 13 }}
device_description_str: "{kind}"
"""


def described_devices(name: str) -> list[jax.Device]:
    """The devices of a TPU slice, such as "v5p:2x2x4", or so many GPUs, "h100:16" (or h20, h200; one without a number).

    Needs the `libtpu` wheel and no TPU, or JAX for CUDA and no GPU (where there is none, with JAX_PLATFORMS=cpu).
    Programs compiled for them have the compiler's own memory figures. Of GPUs, kernels are not timed against one
    another as they are on the device: what cuBLAS would take there may be Triton's here.

    Raises:
      InputError: no such devices are known.
      MissingPackage: their compiler is not installed.
    """
    kind, _, count = name.lower().partition(":")
    if kind in _GPUS:
        return _gpus(name, kind, count or "1")
    expected = f"expected a TPU slice like v5p:2x2x4, or GPUs ({', '.join(_GPUS)}) like h100:16"
    if importlib.util.find_spec("libtpu") is None:
        raise MissingPackage(f"{name}: {expected}; TPUs are described by the libtpu package: pip install libtpu")
    # Otherwise it asks the network which TPU this machine has.
    os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")
    return _topology(f"{name}: no such devices, {expected}", topology_name=name, platform="tpu")


def _gpus(name: str, kind: str, count: str) -> list[jax.Device]:
    if not count.isdecimal() or int(count) < 1:
        raise InputError(f"{name}: expected a number of GPUs after the colon, as in {kind}:16")
    if not gpu_compiler_installed():
        raise MissingPackage(f"{name}: GPUs are described by JAX for CUDA: {install_line('cuda')}")
    failure = f"{name}: this JAX cannot describe GPUs; where there is none it needs JAX_PLATFORMS=cpu"
    target = _TARGET.format(**dataclasses.asdict(_GPUS[kind]))
    # One host: no more is known of how they are joined.
    return _topology(failure, topology_name=kind, platform="cuda", target_config=target, topology=f"1x1x{int(count)}")


def _topology(failure: str, **description: Any) -> list[jax.Device]:
    from jax.experimental import topologies

    try:
        return list(topologies.get_topology_desc(**description).devices)
    except Exception as error:  # of whatever kind the library raises
        raise InputError(f"{failure} ({one_line(error):.200})") from error


def gpu_compiler_installed() -> bool:
    """Whether JAX for CUDA is installed, which brings the compiler."""
    return any(importlib.util.find_spec(f"jax_cuda{version}_plugin") for version in _CUDA_VERSIONS)


def described_bytes(device: jax.Device) -> int | None:
    """Bytes of a described GPU that programs may use, as JAX shares its memory out; None for others."""
    gpu = next((gpu for gpu in _GPUS.values() if gpu.kind == device.device_kind), None)
    return None if gpu is None else int(_SHARE * gpu.memory)


@contextlib.contextmanager
def attention_kernels(device: jax.Device) -> Iterator[str]:
    """Gives the `ModelConfig.attention` that a described device would have; `auto` for one that is there, and is asked
    itself."""
    if device in jax.devices():
        yield "auto"
    elif device.platform == "gpu":
        with cudnn_by_description():
            yield "cudnn"
    else:
        yield "tpu_flash"


@contextlib.contextmanager
def cudnn_by_description() -> Iterator[None]:
    """JAX lowers cuDNN's attention as for a Hopper GPU with cuDNN 9.10, and does not ask the one at hand.

    Raises InputError where this JAX asks in another way."""
    from jax._src.cudnn import fused_attention_stablehlo as module

    answers = {
        "check_cudnn_version": lambda: _CUDNN,
        "check_compute_capability": lambda capability: True,
        "is_cuda_compute_capability_equal": lambda capability: capability == "9.0",
    }
    try:
        held = {name: getattr(module, name) for name in answers}
    except AttributeError as error:
        raise InputError(f"JAX {jax.__version__} cannot lower cuDNN's attention for GPUs that are not there") from error
    for name, answer in answers.items():
        setattr(module, name, answer)
    try:
        yield
    finally:
        for name, function in held.items():
            setattr(module, name, function)
