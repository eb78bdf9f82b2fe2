"""Which clips made an update useless, and how they are named."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import numpy as np

from logvggt_jax.errors import printable

_SHOWN = 16


def clips_to_blame(
    finite: np.ndarray, names: Sequence[str], exchange: Callable[[str], Sequence[str | None]]
) -> tuple[list[str], str]:
    """The clips of an update that was left out, and in words which they are; the same on all processes that hear one
    another.

    Args:
      finite: bool [b], which of this process's clips are not to blame.
      names: of these clips.
      exchange: gives every process's text for this one's, None of one that does not answer.
    """
    wrong = [name for name, fine in zip(names, finite, strict=True) if not fine]
    # Names of all clips are needed only where nobody's is wrong by itself, which nobody knows yet.
    answers = exchange(json.dumps([wrong, list(names)]))
    silent = [process for process, answer in enumerate(answers) if answer is None]
    unknown = f" (those of the processes {silent} are not known)" if silent else ""
    heard = [json.loads(answer) for answer in answers if answer is not None]
    if any(wrong for wrong, _ in heard):
        return [name for wrong, _ in heard for name in wrong], f"in{unknown}"
    # Each by itself is finite, and so are all together with the parameters of a later step.
    everyone = [name for _, names in heard for name in names]
    return everyone, f"with all or some of{unknown}"


def described(clips: Sequence[str]) -> str:
    """Names of clips on one line, the first of many."""
    more = f" and {len(clips) - _SHOWN} more" if len(clips) > _SHOWN else ""
    return printable("; ".join(clips[:_SHOWN])) + more
