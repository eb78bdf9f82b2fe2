"""Batches that lie on the devices before the step that needs them begins."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from jax.sharding import Mesh

from logvggt_jax.data.feeding.batches import BatchIterator
from logvggt_jax.training.parallel.sharding import on_each_device, put_batch
from logvggt_jax.training.step.train_step import Batch


class _Ready(NamedTuple):
    """A batch on the devices, the stream's state after it, the broken clips so far, and the names of its clips."""

    batch: Batch
    state: dict[str, Any]
    broken_clips: int
    names: list[str]


class DeviceBatches(Iterator[Batch]):
    """Batches of `source` split over `mesh`; a context manager that ends its thread.

    While a step runs, a thread puts the next batch together and copies it to the devices, or draws it there where
    the source only describes its pictures: one batch more than the step's own is held there. State and errors are
    those of the batch handed out, not of the one read ahead.

    Attributes:
      broken_clips: clips of this process that were replaced, up to the last batch.
      names: of this process's clips of the last batch.
    """

    def __init__(self, source: BatchIterator, mesh: Mesh) -> None:
        self._source, self._mesh = source, mesh
        self._draw_pictures = None if source.draw is None else on_each_device(source.draw, mesh)
        self._state, self.broken_clips = source.get_state(), source.broken.count
        self.names: list[str] = []
        self._thread = ThreadPoolExecutor(1, "device-batches")
        self._next: Future[_Ready] | None = None

    def __next__(self) -> Batch:
        ready = (self._next or self._thread.submit(self._draw)).result()
        self._next = self._thread.submit(self._draw)
        self._state, self.broken_clips, self.names = ready.state, ready.broken_clips, ready.names
        return ready.batch

    def __enter__(self) -> DeviceBatches:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=True)

    def get_state(self) -> dict[str, Any]:
        """JSON values that the source's `set_state` takes to go on after the last batch handed out."""
        return self._state

    def _draw(self) -> _Ready:
        batch = put_batch(next(self._source), self._mesh)
        if self._draw_pictures is not None:
            batch = self._draw_pictures(batch)
        return _Ready(batch, self._source.get_state(), self._source.broken.count, self._source.names)
