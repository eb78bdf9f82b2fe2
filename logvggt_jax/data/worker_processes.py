"""Processes that work for this one, and that do not outlive it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """So many processes, which import the main script: guard it with `if __name__ == "__main__"`.

    They end with the block, after what they were given; where it fails, after what they have begun. Where this process
    is killed they end at once.
    """
    # Forking a process that runs JAX's threads can deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=end_with_parent) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def end_with_parent() -> None:
    """Has this process, a worker, end as soon as the one that started it is gone, however that ended.

    Who is killed ends no workers: they would wait for work, or for room for what they have done, for ever, with all
    their memory and with the files and terminals that they hold.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None, "called by a worker"

    def end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end, name="end with parent", daemon=True).start()
