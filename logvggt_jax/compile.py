"""Compilation: the devices that were asked for, a cache of compiled programs, and how many were made."""

import contextlib
import functools
import importlib.metadata
import os
import re
import shutil
import time
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import jax.numpy as jnp

from logvggt_jax.errors import InputError, install_line, one_line
from logvggt_jax.files import user_cache_folder, user_path

# What JAX reports for every program it makes.
_COMPILATION = "/jax/core/compile/backend_compile_duration"
_QUICK = {"xla_gpu_experimental_enable_fusion_autotuner": False, "xla_gpu_enable_triton_gemm": False}
# Of each of these one build may be installed, for one version of CUDA; JAX loads whichever it finds first.
_BUILD = re.compile(r"(nvidia-(?:nccl|cudnn|cublas)-cu|jax-cuda)\d+(-plugin|-pjrt)?")


def nvidia_gpu_present() -> bool:
    """Whether this machine has an NVIDIA GPU and its driver, whatever JAX sees."""
    return Path("/dev/nvidia0").exists() or shutil.which("nvidia-smi") is not None


def installed_packages() -> dict[str, str]:
    """Versions of what is installed, by name in small letters."""
    return {each.metadata["Name"].lower(): each.version for each in importlib.metadata.distributions() if each.metadata}


def builds_side_by_side(installed: Iterable[str]) -> dict[str, list[str]]:
    """The libraries of which more than one build is installed, and those builds."""
    families: dict[str, list[str]] = {}
    for name in sorted(installed):
        if match := _BUILD.fullmatch(name):
            families.setdefault(f"{match[1]}*{match[2] or ''}", []).append(name)
    return {family: builds for family, builds in families.items() if len(builds) > 1}


def check_nccl() -> None:
    """Raises InputError where two builds of NCCL are installed: processes may load different ones, and then hang."""
    asked = getattr(jax.config, "jax_platforms", None) or "cuda"
    if not nvidia_gpu_present() or not {"cuda", "gpu"} & set(asked.split(",")):
        return
    for family, builds in builds_side_by_side(installed_packages()).items():
        if "nccl" in family:
            raise InputError(
                f"{' and '.join(builds)} are both installed, and JAX loads whichever it finds first: pip uninstall all "
                f"of them, then {install_line('cuda')}"
            )


def check_devices() -> None:
    """Starts JAX's back end; warns where a GPU lies idle.

    Raises:
      InputError: the platform that JAX_PLATFORMS asks for does not start.
    """
    asked = getattr(jax.config, "jax_platforms", None) or ""
    try:
        platform = jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"JAX_PLATFORMS={asked}: these devices do not start ({one_line(error):.200}); {_mend(asked)} or unset "
            "JAX_PLATFORMS"
        ) from error
    if platform == "cpu" and "cpu" not in asked and nvidia_gpu_present():
        warnings.warn(
            f"JAX computes on the CPU, but this machine has an NVIDIA GPU: {install_line('cuda')}, or set "
            "JAX_PLATFORMS=cpu",
            stacklevel=2,
        )


def _mend(asked: str) -> str:
    built = any(name.startswith("jax-cuda") for name in installed_packages())
    if built and not nvidia_gpu_present() and {"cuda", "gpu"} & set(asked.split(",")):
        return (
            "JAX for NVIDIA GPUs is installed, but no GPU with its driver is there: see that nvidia-smi lists one (in "
            "a container: docker run --gpus all)"
        )
    return f"install JAX for them ({install_line('cuda')} for NVIDIA GPUs)"


@functools.cache
def quick_compilation(device: jax.Device) -> dict[str, bool]:
    """Options for `jax.jit` under which a large program for `device` compiles in a fraction of the time; none but for
    GPUs.

    XLA would compile each of a training step's thousand fusions twice, with two emitters, and time both, and compile
    dozens of Triton kernels for each product beside those of cuBLAS. Options that this XLA does not know are left out.
    """
    return {
        name: value for name, value in _QUICK.items() if device.platform == "gpu" and _accepted(device, name, value)
    }


def _accepted(device: jax.Device, name: str, value: bool) -> bool:
    program = jax.jit(lambda: jnp.zeros(()), out_shardings=jax.sharding.SingleDeviceSharding(device))
    try:
        program.lower().compile({name: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


class Compilations:
    """How many programs XLA has made for this process, and when the last of them, by `time.monotonic`."""

    def __init__(self) -> None:
        self.count, self.last = 0, time.monotonic()

    def heard(self, event: str, duration_secs: float, **_: Any) -> None:
        """Takes what JAX tells of its work."""
        if event == _COMPILATION:
            self.count, self.last = self.count + 1, time.monotonic()


@contextlib.contextmanager
def counted_compilations() -> Iterator[Compilations]:
    """Counts the programs that XLA makes for this process from here on, small ones of single operations among them,
    compiled or taken from the cache."""
    compilations = Compilations()
    jax.monitoring.register_event_duration_secs_listener(compilations.heard)
    try:
        yield compilations
    finally:
        jax.monitoring.unregister_event_duration_listener(compilations.heard)


def out_of_device_memory(error: jax.errors.JaxRuntimeError) -> bool:
    """Whether this is what the back end raises where a program or an array does not fit the device."""
    # So is a file called that has no room on its disk.
    return "RESOURCE_EXHAUSTED" in str(error) and "No space left" not in str(error)


def device_bytes(device: jax.Device) -> int | None:
    """Bytes that programs may use on a device; None where it does not say (CPUs, devices that are described alone)."""
    try:
        statistics = device.memory_stats()
    except jax.errors.JaxRuntimeError:
        return None
    return (statistics or {}).get("bytes_limit")


def most_device_bytes(devices: Iterable[jax.Device]) -> int | None:
    """The most bytes that one of these devices has held so far; None where none says (CPUs)."""
    found = [(device.memory_stats() or {}).get("peak_bytes_in_use") for device in devices]
    return max((size for size in found if size is not None), default=None)


def default_cache_folder() -> Path:
    """`logvggt/xla` in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`)."""
    return user_cache_folder("xla")


def enable_compilation_cache(folder: str | None = None) -> Path | None:
    """Turns JAX's persistent compilation cache on in `folder`, which it returns; `none` leaves it off and gives None.

    The default is JAX's own `JAX_COMPILATION_CACHE_DIR` if set, else `default_cache_folder`, or none for a user without
    a home. Raises InputError where a file has the folder's name.
    """
    folder = folder or os.environ.get("JAX_COMPILATION_CACHE_DIR") or None
    if folder is None:
        with contextlib.suppress(InputError):
            folder = str(default_cache_folder())
    if folder in (None, "none"):
        jax.config.update("jax_enable_compilation_cache", False)
        return None
    chosen = user_path(folder)
    if chosen.exists() and not chosen.is_dir():
        raise InputError(f"{chosen} is no folder: give another --compilation_cache, or `none`")
    jax.config.update("jax_compilation_cache_dir", str(chosen))
    return chosen
