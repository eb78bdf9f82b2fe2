"""Batches over meshes whose axes are explicit in types."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
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

    signature = inspect.signature(method)

    @functools.wraps(method)
    def call(self: Any, *arrays: Any, **options: Any) -> Any:
        given = signature.bind(self, *arrays, **options).arguments
        sharding = _sharding_of_results(given.pop("variables"), given)
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


def _sharding_of_results(variables: Any, others: Any) -> NamedSharding | None:
    """That of the first of the other arrays that is split explicitly along its first axis; not split where parameters
    alone are, and None where nothing is."""
    for sharding in _explicitly_split(others):
        if sharding.spec[0] is not None:
            return NamedSharding(sharding.mesh, PartitionSpec(sharding.spec[0]))
    found = next(_explicitly_split((variables, others)), None)
    return None if found is None else NamedSharding(found.mesh, PartitionSpec())


def _explicitly_split(tree: Any) -> Iterator[NamedSharding]:
    """Shardings of the arrays that are split over axes which are explicit in types."""
    for leaf in jax.tree.leaves(tree):
        sharding = jax.typeof(leaf).sharding if isinstance(leaf, jax.Array) else None
        if sharding is not None and sharding.mesh.explicit_axes and any(part is not None for part in sharding.spec):
            yield sharding
