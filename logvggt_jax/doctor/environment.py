"""Versions and devices, and what is wrong with them."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Iterator

from logvggt_jax.compile import nvidia_gpu_present
from logvggt_jax.doctor.finding import Finding

_LIBRARIES = ("logvggt-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")
# Of each of these one build may be installed; JAX loads whichever it finds first.
_ONE_BUILD = ("nvidia-nccl-cu", "nvidia-cudnn-cu", "nvidia-cublas-cu", "jax-cuda")
_INSTALL = 'pip install "logvggt-jax[cuda]"'


def examine() -> Iterator[Finding]:
    """Finds libraries, devices, and builds that do not belong together."""
    yield Finding("environment", "Python", platform.python_version())
    installed = {
        each.metadata["Name"].lower(): each.version for each in importlib.metadata.distributions() if each.metadata
    }
    for name in _LIBRARIES:
        yield Finding("environment", name, installed.get(name), ok=None if name in installed else False)
    for prefix in _ONE_BUILD:
        builds = sorted(name for name in installed if name.startswith(prefix) and name.endswith(("12", "13")))
        if len(builds) > 1:
            note = f"pip uninstall all but one, then {_INSTALL}"
            yield Finding("environment", f"builds of {prefix}*", ", ".join(builds), ok=False, note=note)
    yield from _devices()


def _devices() -> Iterator[Finding]:
    import jax

    try:
        devices = jax.devices()
    except RuntimeError as error:
        # What the backend says: a driver too old, a library that is missing, a platform that is not there.
        reason = " ".join(str(error).split())
        yield Finding("environment", "devices", None, ok=False, note=f"{reason:.300}")
        return
    kinds = ", ".join(sorted({device.device_kind for device in devices}))
    yield Finding("environment", "devices", f"{len(devices)} x {kinds}", note=f"platform {jax.default_backend()}")
    if jax.default_backend() == "cpu" and nvidia_gpu_present():
        yield Finding("environment", "NVIDIA GPU", "not used", ok=False, note=_why_no_gpu())
    if jax.default_backend() == "gpu":
        yield _cudnn()


def _why_no_gpu() -> str:
    import jax

    try:
        jax.devices("cuda")
    except RuntimeError as error:
        # A back end that was installed and failed says why, a driver too old for example.
        if "failed to initialize" in str(error):
            return f"{' '.join(str(error).split()):.300}"
    return f"JAX computes on the CPU of a machine with an NVIDIA GPU: {_INSTALL}"


def _cudnn() -> Finding:
    import jax
    import jax.numpy as jnp

    tokens = jnp.ones((1, 16, 1, 64), jnp.bfloat16)
    try:
        jax.block_until_ready(jax.nn.dot_product_attention(tokens, tokens, tokens, implementation="cudnn"))
    except Exception as error:  # of whatever kind the library raises
        reason = " ".join(str(error).split())
        return Finding("environment", "cuDNN attention", "refused", ok=False, note=f"{reason:.300}")
    return Finding("environment", "cuDNN attention", "works", ok=True)
