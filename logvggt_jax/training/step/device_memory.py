"""A device that is out of memory, in words that say what to change."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from typing import Any

import jax
from jax.sharding import Mesh

from logvggt_jax.compile import device_bytes, out_of_device_memory
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.training.config import StageConfig, ValidationConfig

_GIB = 2**30


@contextlib.contextmanager
def memory_explained(stage: StageConfig, mesh: Mesh, steps: Collection[jax.stages.Compiled]) -> Iterator[None]:
    """Turns a device's being out of memory into an InputError of one line: what the largest of `steps`, as they are
    then, needs, and what lowers it."""
    with _explained(
        lambda: (
            f"stage {stage.name!r} does not fit the memory of {_described(mesh.devices.flat[0], steps)}: lower stages."
            f"{stage.name}.batch_size={stage.batch_size} ({stage.batch_size // mesh.size} clips a device) or "
            f"clip_length={stage.clip_length}, or train on more devices; --dry_run says what fits"
        )
    ):
        yield


@contextlib.contextmanager
def validation_memory_explained(config: ValidationConfig, mesh: Mesh) -> Iterator[None]:
    """The same for validation, which takes other clips than the steps do and does not depend on their batch size."""
    with _explained(
        lambda: (
            f"validation does not fit the memory of {_described(mesh.devices.flat[0], ())}, which takes one clip at a "
            f"time: lower validation.size={config.size} or validation.clip_length={config.clip_length}"
        )
    ):
        yield


@contextlib.contextmanager
def _explained(words: Callable[[], str]) -> Iterator[None]:
    """Turns a device's being out of memory into an InputError with these words and the reason."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if not out_of_device_memory(error):
            raise
        raise InputError(f"{words()} ({one_line(error):.200})") from error


def _described(device: jax.Device, steps: Collection[jax.stages.Compiled]) -> str:
    limit, text = device_bytes(device), str(device.device_kind)
    if limit is not None:
        text += f", {limit / _GIB:.1f} GiB"
    known: list[Any] = [step.memory_analysis() for step in steps]
    needs = [memory.argument_size_in_bytes + memory.temp_size_in_bytes for memory in known if memory is not None]
    return text + (f", where the largest step needs {max(needs) / _GIB:.1f} GiB" if needs else "")
