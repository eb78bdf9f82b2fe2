"""Versions and devices, and what is wrong with them."""

from __future__ import annotations

import platform
from collections.abc import Iterator

from logvggt_jax.compile import builds_side_by_side, installed_packages, nvidia_gpu_present
from logvggt_jax.doctor.finding import Finding
from logvggt_jax.errors import install_line, one_line

_LIBRARIES = ("logvggt-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


def examine() -> Iterator[Finding]:
    """Finds libraries, devices, and builds that do not belong together."""
    yield Finding("environment", "Python", platform.python_version())
    installed = installed_packages()
    for name in _LIBRARIES:
        yield Finding("environment", name, installed.get(name), ok=None if name in installed else False)
    for family, builds in builds_side_by_side(installed).items():
        note = f"pip uninstall all but one, then {install_line('cuda')}"
        yield Finding("environment", f"builds of {family}", ", ".join(builds), ok=False, note=note)
    yield from _devices()


def _devices() -> Iterator[Finding]:
    import jax

    try:
        devices = jax.devices()
    except RuntimeError as error:
        # What the backend says: a driver too old, a library that is missing, a platform that is not there.
        yield Finding("environment", "devices", None, ok=False, note=f"{one_line(error):.300}")
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
            return f"{one_line(error):.300}"
    return f"JAX computes on the CPU of a machine with an NVIDIA GPU: {install_line('cuda')}"


def _cudnn() -> Finding:
    import jax
    import jax.numpy as jnp

    tokens = jnp.ones((1, 16, 1, 64), jnp.bfloat16)
    try:
        jax.block_until_ready(jax.nn.dot_product_attention(tokens, tokens, tokens, implementation="cudnn"))
    except Exception as error:  # of whatever kind the library raises
        return Finding("environment", "cuDNN attention", "refused", ok=False, note=f"{one_line(error):.300}")
    return Finding("environment", "cuDNN attention", "works", ok=True)
