"""Which clips were in the batches whose updates were left out."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from absl import logging

from logvggt_jax.training.step import Metrics

_SHOWN = 16


class _Begun(NamedTuple):
    """A step handed to the devices, what it will return, and the names of this process's clips."""

    step: int
    metrics: Metrics
    finite: jax.Array
    clips: Sequence[str]


class SkippedUpdates:
    """Follows the steps in flight; a warning names the clips of a batch whose update was left out.

    Args:
      skipped: updates left out before.
      in_flight: steps that may be unfinished before the oldest is waited for.

    Attributes:
      clips: of this process, in the latest updates left out in a row.
    """

    def __init__(self, skipped: int, *, in_flight: int) -> None:
        self.clips: list[str] = []
        self._in_flight, self._skipped, self._last_skip = in_flight, skipped, 0
        self._begun: deque[_Begun] = deque()

    def begun(self, step: int, metrics: Metrics, finite: jax.Array, clips: Sequence[str]) -> None:
        """Notes a step; waits for older ones so that no more than `in_flight` are unfinished."""
        self._begun.append(_Begun(step, metrics, finite, clips))
        self._finish(self._in_flight)

    def finish(self) -> None:
        """Waits for all steps."""
        self._finish(0)

    def _finish(self, left: int) -> None:
        while len(self._begun) > left:
            oldest = self._begun.popleft()
            skipped = int(oldest.metrics["skipped"])
            if skipped > self._skipped:
                self._name(oldest)
            self._skipped = skipped

    def _name(self, skip: _Begun) -> None:
        finite = _own(skip.finite)
        # Where all clips by themselves are finite, it is their gradient or a sum over them that is not.
        named = [name for name, good in zip(skip.clips, finite, strict=True) if not good] or list(skip.clips)
        if skip.step != self._last_skip + 1:
            self.clips.clear()
        self._last_skip = skip.step
        self.clips += [name for name in named if name not in self.clips]
        one = "not finite in" if not finite.all() else "with a non-finite loss or gradient, of"
        logging.warning("step %d: update left out, %s %s", skip.step, one, described(named))


def described(clips: Sequence[str]) -> str:
    """Names of clips on one line, the first of many."""
    more = f" and {len(clips) - _SHOWN} more" if len(clips) > _SHOWN else ""
    return "; ".join(clips[:_SHOWN]) + more


def _own(finite: jax.Array) -> np.ndarray:
    """This process's part of an array that is split over the devices, in its order."""
    shards = sorted(finite.addressable_shards, key=lambda shard: shard.index[0].start or 0)
    return np.concatenate([np.asarray(shard.data) for shard in shards])
