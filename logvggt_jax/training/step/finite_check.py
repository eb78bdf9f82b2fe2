"""Which clips made the gradient of an update non-finite, where each one's loss is finite."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from logvggt_jax.compile import quick_compilation
from logvggt_jax.training.config import LossConfig
from logvggt_jax.training.parallel.sharding import DATA_AXIS, Layout, split
from logvggt_jax.training.step.optimizer import module_norms
from logvggt_jax.training.step.train_step import Batch, LossTerms, all_finite, loss_and_gradients

# Per-clip arrays that say what was seen; a clip without depth counts in no term of the loss.
_SEEN = ("images", "depth", "confidence")


def make_finite_check(
    terms: LossTerms, config: LossConfig, layout: Layout, *, accumulate: int = 1
) -> jax.stages.Wrapped:
    """A jitted function (parameters, batch, bool [B] which clips count) -> bool scalar: whether loss and gradient of
    these clips alone are finite.

    Parameters lie as `layout` says, the batch and `accumulate` are those of `make_train_step`. Clips that do not count
    are black pictures without depth. Nothing is donated or changed.
    """

    def check(params: Any, batch: Batch, counted: jax.Array) -> jax.Array:
        def shown(x: jax.Array) -> jax.Array:
            return jnp.where(counted.reshape(-1, *(1,) * (x.ndim - 1)), x, jnp.zeros((), x.dtype))

        counting = {name: shown(x) if name in _SEEN else x for name, x in batch.items()}
        total, _, gradients, _ = loss_and_gradients(terms, config, params, counting, layout, accumulate=accumulate)
        return all_finite(total, module_norms(gradients, layout.norm))

    def on_all_devices(params: Any, batch: Batch, counted: jax.Array) -> jax.Array:
        in_specs = (layout.specs(params), P(DATA_AXIS), P(DATA_AXIS))
        return jax.shard_map(check, mesh=layout.mesh, in_specs=in_specs, out_specs=P(), check_vma=False)(
            params, batch, counted
        )

    return jax.jit(on_all_devices, compiler_options=quick_compilation(layout.mesh.devices.flat[0]))


def non_finite_clips(check: Callable[..., jax.Array], params: Any, batch: Batch, layout: Layout) -> np.ndarray:
    """bool [B]: the clips of a global batch whose gradients are not finite, by `make_finite_check`.

    All processes have to ask at the same point, and hear the same. None is named where all together are finite by now.
    """
    sharding, count = split(layout.mesh), batch["images"].shape[0]

    def fails(clips: np.ndarray) -> bool:
        counted = np.isin(np.arange(count), clips)
        return not bool(check(params, batch, jax.make_array_from_callback((count,), sharding, counted.__getitem__)))

    found = np.zeros(count, bool)
    found[failing(fails, count)] = True
    return found


def failing(fails: Callable[[np.ndarray], bool], count: int) -> list[int]:
    """The numbers below `count` for which a group `fails` that holds them, found by halving groups.

    One of many is found in about twice their logarithm's tries. Those that fail together alone are all named, and so
    are those of groups that are not yet told apart after four times the logarithm.
    """
    everyone = np.arange(count)
    if not fails(everyone):
        return []
    tries = 4 * max(count - 1, 1).bit_length()
    groups, found = deque([everyone]), []
    while groups:
        group = groups.popleft()
        halves = np.array_split(group, 2) if group.size > 1 and tries >= 2 else []
        tries -= len(halves)
        parts = [half for half in halves if fails(half)]
        groups += parts
        if not parts:
            found += group.tolist()
    return sorted(found)
