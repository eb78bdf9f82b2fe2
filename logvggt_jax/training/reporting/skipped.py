"""Which clips made an update useless, and how they are named."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import jax
import numpy as np

from logvggt_jax.errors import printable

_SHOWN = 16


def clips_to_blame(
    finite: jax.Array, names: Sequence[str], exchange: Callable[[str], Sequence[str | None]]
) -> tuple[list[str], str]:
    """The clips of an update that was left out, and in words what is wrong with them; the same on all processes
    that hear one another.

    Args:
      finite: bool [B], of `make_train_step`, split over the devices.
      names: of this process's clips, in their order.
      exchange: gives every process's text for this one's, None of one that does not answer.
    """
    shards = sorted(finite.addressable_shards, key=lambda shard: shard.index[0].start or 0)
    good = np.concatenate([np.asarray(shard.data) for shard in shards])
    wrong = [name for name, fine in zip(names, good, strict=True) if not fine]
    # Names of all clips are needed only where nobody's is wrong by itself, which nobody knows yet.
    answers = exchange(json.dumps([wrong, list(names)]))
    silent = [process for process, answer in enumerate(answers) if answer is None]
    unknown = f" (those of the processes {silent} are not known)" if silent else ""
    heard = [json.loads(answer) for answer in answers if answer is not None]
    if any(wrong for wrong, _ in heard):
        return [name for wrong, _ in heard for name in wrong], f"loss was not finite in{unknown}"
    # Each by itself is finite: it is their gradient or a sum over them that is not.
    everyone = [name for _, names in heard for name in names]
    return everyone, f"loss or gradient was not finite, with all or some of{unknown}"


def described(clips: Sequence[str]) -> str:
    """Names of clips on one line, the first of many."""
    more = f" and {len(clips) - _SHOWN} more" if len(clips) > _SHOWN else ""
    return printable("; ".join(clips[:_SHOWN])) + more
