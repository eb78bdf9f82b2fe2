"""Batches that lie on the devices before the step that needs them begins."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from jax.sharding import Mesh

from logvggt_jax.data.feeding.batches import Batch as HostBatch
from logvggt_jax.data.feeding.batches import BatchIterator
from logvggt_jax.training.parallel.sharding import on_each_device, put_batch
from logvggt_jax.training.step.train_step import Batch


class _Known(NamedTuple):
    """Of a batch: the stream's state after it, the broken clips so far, and the names of its clips."""

    state: dict[str, Any]
    broken_clips: int
    names: list[str]


class DeviceBatches(Iterator[Batch]):
    """Batches of `source` split over `mesh`; a context manager that ends its thread.

    While a step runs, a thread puts the next batch together and copies it to the devices, or draws it there where
    the source only describes its pictures: one batch more than the step's own is held there. State and errors are
    those of the batch handed out, not of those read ahead.

    Args:
      ahead: batches that are read before they are asked for; all but one of them wait on the host.

    Attributes:
      broken_clips: clips of this process that were replaced, up to the last batch.
      names: of this process's clips of the last batch.
    """

    def __init__(self, source: BatchIterator, mesh: Mesh, *, ahead: int = 1) -> None:
        self._source, self._mesh, self._ahead = source, mesh, ahead
        self._draw_pictures = None if source.draw is None else on_each_device(source.draw, mesh)
        self._state, self.broken_clips = source.get_state(), source.broken.count
        self.names: list[str] = []
        self._thread = ThreadPoolExecutor(1, "device-batches")
        self._next: Future[tuple[Batch, _Known]] | None = None
        self._later: deque[Future[tuple[HostBatch, _Known]]] = deque()
        self._failure: BaseException | None = None

    def __next__(self) -> Batch:
        batch, known = self._following().result()
        self._next = None
        self._following()
        self._state, self.broken_clips, self.names = known.state, known.broken_clips, known.names
        return batch

    def __enter__(self) -> DeviceBatches:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=True)

    def get_state(self) -> dict[str, Any]:
        """JSON values that the source's `set_state` takes to go on after the last batch handed out."""
        return self._state

    def failure(self, count: int) -> BaseException | None:
        """What keeps one of the next `count` batches, no more than are read ahead, from being handed out; waits until
        that is known."""
        coming: list[Future[Any]] = [self._following(), *self._later]
        for batch in coming[:count]:
            if (failure := batch.exception()) is not None:
                return failure
        return None

    def _following(self) -> Future[tuple[Batch, _Known]]:
        """The next batch, which begins its way to the devices before any later one is read."""
        if self._next is None:
            read = self._later.popleft() if self._later else self._thread.submit(self._read)
            self._next = self._thread.submit(self._placed, read)
        while len(self._later) < self._ahead - 1:
            self._later.append(self._thread.submit(self._read))
        return self._next

    def _read(self) -> tuple[HostBatch, _Known]:
        # The source would go on with a batch that could not be read: it would come in a later one's place.
        if self._failure is not None:
            raise self._failure
        try:
            batch = next(self._source)
        except BaseException as failure:
            self._failure = failure
            raise
        return batch, _Known(self._source.get_state(), self._source.broken.count, self._source.names)

    def _placed(self, read: Future[tuple[HostBatch, _Known]]) -> tuple[Batch, _Known]:
        on_host, known = read.result()
        batch = put_batch(on_host, self._mesh)
        if self._draw_pictures is not None:
            batch = self._draw_pictures(batch)
        return batch, known
