"""The use of a cache by many runs at once, and the removal of what killed ones left half-written in it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def cache_in_use(cache: Path, name: str, scratch: tuple[str, ...]) -> Iterator[None]:
    """Who writes what is called `name` to `cache` does so in this block, at the same time as other processes and runs.

    One that comes while no other is there removes temporary folders first, which match the patterns `scratch` below
    `cache` and then are of killed ones. All that are there hold one lock together, `<cache>/<name>.lock`, which ends
    with its process, however that ends. Where nothing can be written, or the file system or the operating system has no
    such locks, nothing is removed: what is written is all the same.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError, ImportError):
            import fcntl

            cache.mkdir(parents=True, exist_ok=True)
            # Network file systems ask for a file open for writing to lock it alone, for reading to lock it together.
            lock = stack.enter_context((cache / f"{name}.lock").open("a+b"))
            if _is_alone(lock):
                for path in (path for pattern in scratch for path in cache.glob(pattern)):
                    shutil.rmtree(path, ignore_errors=True)
            fcntl.flock(lock, fcntl.LOCK_SH)
        yield


def _is_alone(lock: BinaryIO) -> bool:
    """Whether nobody else holds the lock; who is alone keeps others waiting until it holds the lock together."""
    import fcntl

    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
