"""Work on frames in threads beside the one that feeds the device.

Decoding, resizing, encoding and most of numpy let go of the interpreter's lock, so that threads suffice.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Any, TypeVar

from logvggt_jax.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_MOST_WORKERS = 8
_END: Any = object()


class FramePool:
    """A few threads that share what there is to do, in the order in which it was asked for.

        with FramePool() as pool:
            for picture in pool.map(decode, files):
                pool.submit(write, picture)
            pool.finish()

    Leaving the block waits for the work in progress; after an error what was not begun is dropped.

    Args:
      workers: threads; None for one a core, at most eight.
    """

    def __init__(self, workers: int | None = None) -> None:
        if workers is not None and workers < 1:
            raise InputError(f"workers must be at least 1, got {workers}")
        count = workers or min(_MOST_WORKERS, os.cpu_count() or 1)
        self._ahead = 2 * count + 2
        self._workers = ThreadPoolExecutor(count, thread_name_prefix="frames")
        # Items are drawn in a thread of their own: one at a time, in order, and not by whoever waits for results.
        self._source = ThreadPoolExecutor(1, thread_name_prefix="source")
        self._jobs: deque[Future[Any]] = deque()

    def __enter__(self) -> FramePool:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        for pool in (self._source, self._workers):
            pool.shutdown(cancel_futures=kind is not None)

    def map(self, function: Callable[[Item], Result], items: Iterator[Item]) -> Iterator[Result]:
        """`function` of each item, in order, a few items ahead of the caller.

        An error, of the items or of the function, is raised in its place.
        """

        def ask() -> None:
            item = self._source.submit(next, items, _END)
            waiting.append(self._workers.submit(lambda: _END if item.result() is _END else function(item.result())))

        waiting: deque[Future[Any]] = deque()
        for _ in range(self._ahead):
            ask()
        while (result := waiting.popleft().result()) is not _END:
            ask()
            yield result
            del result

    def submit(self, function: Callable[..., object], *arguments: Any) -> None:
        """Lets a worker call `function`; waits while too many calls are.

        Raises:
          Whatever an earlier call raised.
        """
        while self._jobs and (self._jobs[0].done() or len(self._jobs) >= 2 * self._ahead):
            self._jobs.popleft().result()
        self._jobs.append(self._workers.submit(function, *arguments))

    def settle(self) -> None:
        """Waits until all submitted calls are done, whatever becomes of them."""
        wait(self._jobs)
        self._jobs.clear()

    def finish(self) -> None:
        """Waits until all submitted calls are done; raises what one of them raised."""
        while self._jobs:
            self._jobs.popleft().result()
