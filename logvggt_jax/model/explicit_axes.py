"""Batches over meshes whose axes are explicit in types."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.sharding import NamedSharding, PartitionSpec, auto_axes

Method = TypeVar("Method", bound=Callable[..., Any])


def splits_as_its_batch(method: Method) -> Method:
    """Lets a method of (self, variables, arrays …) run over meshes of `AxisType.Explicit`.

    Where an array is split explicitly, the compiler partitions what happens inside, and results are split along their
    first axis as the batch is: the arrays after the variables, however those are split. The model itself does not know
    how it is split.
    """

    @functools.wraps(method)
    def call(self: Any, *arrays: Any, **options: Any) -> Any:
        batch = {name: value for name, value in options.items() if name != "variables"}
        others = arrays if "variables" in options else arrays[1:]
        sharding = _explicit_batch((others, batch)) or _whole((arrays, options))
        if sharding is None:
            return method(self, *arrays, **options)
        named = {name: value for name, value in options.items() if _holds_arrays(value)}
        rest = {name: value for name, value in options.items() if name not in named}

        def inside(arrays: tuple[Any, ...], named: dict[str, Any]) -> Any:
            return method(self, *arrays, **named, **rest)

        return auto_axes(inside, out_sharding=sharding)(arrays, named)

    return call  # type: ignore[return-value]


def _holds_arrays(value: Any) -> bool:
    return any(hasattr(leaf, "dtype") for leaf in jax.tree.leaves(value))


def _explicit_batch(tree: Any) -> NamedSharding | None:
    """How the first array that is split explicitly along its first axis is split there; None where none is."""
    for leaf in jax.tree.leaves(tree):
        sharding = jax.typeof(leaf).sharding if isinstance(leaf, jax.Array) else None
        if sharding is not None and sharding.mesh.explicit_axes and sharding.spec and sharding.spec[0] is not None:
            return NamedSharding(sharding.mesh, PartitionSpec(sharding.spec[0]))
    return None


def _whole(tree: Any) -> NamedSharding | None:
    """Results that are not split, on the mesh of the first array that is split explicitly; None where none is."""
    for leaf in jax.tree.leaves(tree):
        sharding = jax.typeof(leaf).sharding if isinstance(leaf, jax.Array) else None
        if sharding is not None and sharding.mesh.explicit_axes and any(part is not None for part in sharding.spec):
            return NamedSharding(sharding.mesh, PartitionSpec())
    return None
