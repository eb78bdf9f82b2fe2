"""Where arrays live: batches split along the mesh axis `data`, parameters whole on every device or split likewise."""

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from logvggt_jax.errors import InputError
from logvggt_jax.model.parameters import Part, is_stack
from logvggt_jax.training.config import StageConfig, TrainConfig

DATA_AXIS = "data"


def data_mesh(num_devices: int | None = None) -> Mesh:
    """A one-dimensional mesh over the first `num_devices` devices, all by default."""
    devices = jax.devices()[:num_devices]
    return jax.make_mesh((len(devices),), (DATA_AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def use_cpu_cores(config: TrainConfig, *, num_processes: int = 1) -> None:
    """Makes devices of a CPU's cores, as many as the batches of all stages split over, there in
    `config.accumulate` parts; before JAX's first use.

    One core computes a step of a small model; data parallelism puts the others to work. Accelerators are not
    affected.
    """
    clips = math.gcd(*(stage.batch_size for stage in config.stages))
    common = max(clips // (num_processes * config.accumulate), 1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_num_cpu_devices", max((n for n in range(1, cores + 1) if common % n == 0), default=1))


def replicated(mesh: Mesh) -> NamedSharding:
    """The whole array on each device."""
    return NamedSharding(mesh, P())


def split(mesh: Mesh) -> NamedSharding:
    """The leading axis split over the devices."""
    return NamedSharding(mesh, P(DATA_AXIS))


def check_batch_size(stage: StageConfig, mesh: Mesh, *, accumulate: int = 1) -> None:
    """Raises InputError unless the stage's batches split evenly over the devices, and there in `accumulate` parts."""
    parts = mesh.size * accumulate
    if stage.batch_size % parts:
        in_parts = f" in accumulate={accumulate} parts each" if accumulate > 1 else ""
        raise InputError(
            f"stage {stage.name!r}: batch_size={stage.batch_size} does not split over {mesh.size} devices{in_parts}; "
            f"use a multiple of {parts}"
        )


@dataclasses.dataclass(frozen=True)
class Layout:
    """Which parameters are split over the devices of `mesh`, and along which axis; moments and averages lie like them.

    `axes` holds the split ones by the names on their path, with the axis counted from the end. `specs` and `shardings`
    are of whole trees; the other functions are called within `shard_map`, where each device has its part.
    """

    mesh: Mesh
    axes: Mapping[tuple[str, ...], int]

    def specs(self, tree: Any) -> Any:
        """Of every leaf of a tree of parameters, or of a state that holds such trees: how it is split."""

        def spec(path: Any, leaf: Any) -> P:
            axis = self._axis(path)
            if axis is None:
                return P()
            names: list[str | None] = [None] * leaf.ndim
            names[axis] = DATA_AXIS
            return P(*names)

        return jax.tree_util.tree_map_with_path(spec, tree)

    def shardings(self, tree: Any) -> Any:
        """`specs` as shardings on the mesh."""
        return jax.tree.map(lambda spec: NamedSharding(self.mesh, spec), self.specs(tree))

    def abstract(self, tree: Any) -> Any:
        """Shapes of a tree with their shardings."""
        return jax.tree.map(
            lambda x, sharding: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree, self.shardings(tree)
        )

    def put(self, tree: Any) -> Any:
        """Arrays on this host, the same on all, on the devices: none ever holds more than its part."""

        def placed(array: Any, sharding: NamedSharding) -> jax.Array:
            on_host = np.asarray(array)
            places = sharding.addressable_devices_indices_map(on_host.shape)
            # Copied: on CPUs all devices could have this very memory, and a step is given it to overwrite.
            parts = [jax.device_put(np.array(on_host[index]), device) for device, index in places.items()]
            return jax.make_array_from_single_device_arrays(on_host.shape, sharding, parts)

        return jax.tree.map(placed, tree, self.shardings(tree))

    def in_parts(self, params: Any) -> Any:
        """This device's parameters as the model takes them: `Part`s where they are split."""

        def part(path: Any, leaf: jax.Array) -> Any:
            axis = self._axis(path)
            return leaf if axis is None else Part(leaf, axis, DATA_AXIS)

        return jax.tree_util.tree_map_with_path(part, params)

    def sum(self, gradients: Any) -> Any:
        """Sums over the devices of gradients that each has found; those of split parameters are sums already."""

        def summed(path: Any, leaf: jax.Array) -> jax.Array:
            return jax.lax.psum(leaf, DATA_AXIS) if self._axis(path) is None else leaf

        if not self.axes:
            return jax.lax.psum(gradients, DATA_AXIS)
        return jax.tree_util.tree_map_with_path(summed, gradients)

    def norm(self, tree: Any) -> jax.Array:
        """l2 norm of all leaves of a tree of parameters, or of a part of one under its own names."""
        if not self.axes:
            return optax.tree.norm(tree)
        split, whole = jnp.zeros(()), jnp.zeros(())
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            squares = jnp.square(leaf.astype(jnp.float32)).sum()
            if self._axis(path) is None:
                whole += squares
            else:
                split += squares
        return jnp.sqrt(whole + jax.lax.psum(split, DATA_AXIS))

    def _axis(self, path: Any) -> int | None:
        """Moments lie deeper in a state than the parameters in their tree: the end of the path decides."""
        names = tuple(str(entry.key) for entry in path if isinstance(entry, jax.tree_util.DictKey))
        return next((self.axes[names[i:]] for i in range(len(names)) if names[i:] in self.axes), None)


def parameter_layout(params: Any, mesh: Mesh, *, shard: bool) -> Layout:
    """Where parameters of these shapes lie: whole on every device, or with `shard` split over them.

    Of a matrix or convolution kernel the longest axis that the number of devices divides is split, never that of the
    layers of a stack, which are put together one by one. Vectors, which are few numbers, stay whole, and so does what
    nothing divides.
    """
    axes: dict[tuple[str, ...], int] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(params) if shard and mesh.size > 1 else ():
        names = tuple(str(entry.key) for entry in path)
        own = leaf.shape[1:] if any(map(is_stack, names)) else leaf.shape
        divisible = [axis for axis in range(-len(own), 0) if own[axis] % mesh.size == 0]
        if len(own) > 1 and divisible:
            axes[names] = max(divisible, key=lambda axis: own[axis])
    return Layout(mesh, axes)


def put_batch(batch: Mapping[str, np.ndarray], mesh: Mesh) -> dict[str, jax.Array]:
    """Arrays of this process [b, ...] as global arrays [B, ...], split over the mesh."""
    sharding = split(mesh)
    return {key: jax.make_array_from_process_local_data(sharding, value) for key, value in batch.items()}


def on_each_device(function: Callable[[Any], Any], mesh: Mesh) -> jax.stages.Wrapped:
    """`function` of a batch, jitted: every device computes its own share, and nothing is exchanged."""
    sharded = jax.shard_map(function, mesh=mesh, in_specs=P(DATA_AXIS), out_specs=P(DATA_AXIS), check_vma=False)
    return jax.jit(sharded)
