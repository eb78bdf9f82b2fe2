"""Steps that the devices work on while the host goes on, and what the finished ones say."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from absl import logging

from logvggt_jax.training.parallel.agreement import Exchange, any_process
from logvggt_jax.training.reporting.progress import IntervalMeans
from logvggt_jax.training.reporting.skipped import clips_to_blame, described
from logvggt_jax.training.step.train_step import Batch, Metrics

# Steps handed to the device before the oldest has to be finished: enough to hide the host's work.
MOST = 2


class _Begun(NamedTuple):
    """A step, what it returns, its clips and the names of this process's."""

    step: int
    metrics: Metrics
    finite: jax.Array
    batch: Batch
    names: list[str]


class StepsInFlight:
    """Takes down the metrics of steps in their order, each when it has finished.

    Attributes:
      means: of the steps that have finished since they were last read.
      longest_skip: updates left out in a row, the longest row since this start; it may have begun before.
    """

    def __init__(
        self,
        *,
        skipped: int,
        in_a_row: int,
        step_ended: Callable[[], None],
        non_finite_clips: Callable[[Batch], np.ndarray],
    ) -> None:
        """Args: `skipped` updates were left out before, `in_a_row` of them last; `step_ended` is called for every step
        that has finished; `non_finite_clips` finds those of a batch, bool [B], whose gradients are not finite."""
        self.means = IntervalMeans()
        self.longest_skip = 0
        self._in_a_row = in_a_row
        self._skipped, self._step_ended = float(skipped), step_ended
        self._non_finite_clips = non_finite_clips
        self._steps: deque[_Begun] = deque()
        self._exchange = Exchange("skipped")
        # Clips of the latest updates left out in a row, and its last step.
        self._blamed: list[str] = []
        self._last_skip = -1

    @property
    def blamed(self) -> str:
        """In words, the clips of the latest updates that were left out in a row."""
        return described(self._blamed)

    def add(self, step: int, metrics: Metrics, finite: jax.Array, batch: Batch, names: list[str]) -> None:
        """A step that was begun, what it returns, its clips and the names of this process's; waits while too many
        run."""
        self._steps.append(_Begun(step, metrics, finite, batch, names))
        self.finish(MOST)

    def finish(self, allowed: int = 0) -> None:
        """Waits until no more than `allowed` steps are unfinished."""
        while len(self._steps) > allowed:
            begun = self._steps.popleft()
            values = {name: float(value) for name, value in jax.device_get(begun.metrics).items()}
            self._step_ended()
            self.means.add(values)
            if values["skipped"] > self._skipped:
                # All processes have the same counter and find the same steps left out.
                self._blame(begun)
                self._in_a_row += 1
                self.longest_skip = max(self.longest_skip, self._in_a_row)
            else:
                self._in_a_row = 0
            self._skipped = values["skipped"]

    def _blame(self, begun: _Begun) -> None:
        step, what = begun.step, "loss"
        shards = sorted(begun.finite.addressable_shards, key=lambda shard: shard.index[0].start or 0)
        finite = np.concatenate([np.asarray(shard.data) for shard in shards])
        if not any_process(not finite.all()):
            what = "loss or gradient"
            everywhere = self._non_finite_clips(begun.batch)
            finite = ~np.concatenate([everywhere[shard.index[0]] for shard in shards])
        clips, which = clips_to_blame(finite, begun.names, functools.partial(self._exchange, step))
        if step != self._last_skip + 1:
            self._blamed.clear()
        self._last_skip = step
        self._blamed += [name for name in clips if name not in self._blamed]
        logging.warning("step %d: update left out, %s was not finite %s %s", step, what, which, described(clips))
