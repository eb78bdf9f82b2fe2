"""Which clips made an update useless, and how they are named."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from logvggt_jax.errors import printable

_SHOWN = 16


def clips_to_blame(finite: jax.Array, names: Sequence[str]) -> tuple[list[str], str]:
    """The clips of an update that was left out, and in words what is wrong with them.

    Args:
      finite: bool [B], of `make_train_step`, split over the devices.
      names: of this process's clips, in their order.
    """
    shards = sorted(finite.addressable_shards, key=lambda shard: shard.index[0].start or 0)
    good = np.concatenate([np.asarray(shard.data) for shard in shards])
    if good.all():
        # Each by itself is finite: it is their gradient or a sum over them that is not, or a clip of another process.
        return list(names), "loss or gradient was not finite, with all or some of"
    return [name for name, fine in zip(names, good, strict=True) if not fine], "loss was not finite in"


def described(clips: Sequence[str]) -> str:
    """Names of clips on one line, the first of many."""
    more = f" and {len(clips) - _SHOWN} more" if len(clips) > _SHOWN else ""
    return printable("; ".join(clips[:_SHOWN])) + more
