"""Where arrays live: parameters on every device, batches split along the mesh axis `data`."""

import math
import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import StageConfig, TrainConfig

DATA_AXIS = "data"


def data_mesh(num_devices: int | None = None) -> Mesh:
    """A one-dimensional mesh over the first `num_devices` devices, all by default."""
    devices = jax.devices()[:num_devices]
    return jax.make_mesh((len(devices),), (DATA_AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def use_cpu_cores(config: TrainConfig, *, num_processes: int = 1) -> None:
    """Makes devices of a CPU's cores, as many as the batches of all stages split over; before JAX's first use.

    One core computes a step of a small model; data parallelism puts the others to work. Accelerators are not
    affected.
    """
    common = math.gcd(*(stage.batch_size for stage in config.stages)) // num_processes
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_num_cpu_devices", max((n for n in range(1, cores + 1) if common % n == 0), default=1))


def replicated(mesh: Mesh) -> NamedSharding:
    """The whole array on each device."""
    return NamedSharding(mesh, P())


def split(mesh: Mesh) -> NamedSharding:
    """The leading axis split over the devices."""
    return NamedSharding(mesh, P(DATA_AXIS))


def check_batch_size(stage: StageConfig, mesh: Mesh) -> None:
    """Raises InputError unless the stage's batches split evenly over the devices."""
    if stage.batch_size % mesh.size:
        raise InputError(
            f"stage {stage.name!r}: batch_size={stage.batch_size} does not split over {mesh.size} devices; "
            f"use a multiple of {mesh.size}"
        )


def put_batch(batch: Mapping[str, np.ndarray], mesh: Mesh) -> dict[str, jax.Array]:
    """Arrays of this process [b, ...] as global arrays [B, ...], split over the mesh."""
    sharding = split(mesh)
    return {key: jax.make_array_from_process_local_data(sharding, value) for key, value in batch.items()}


def on_each_device(function: Callable[[Any], Any], mesh: Mesh) -> jax.stages.Wrapped:
    """`function` of a batch, jitted: every device computes its own share, and nothing is exchanged."""
    sharded = jax.shard_map(function, mesh=mesh, in_specs=P(DATA_AXIS), out_specs=P(DATA_AXIS), check_vma=False)
    return jax.jit(sharded)
