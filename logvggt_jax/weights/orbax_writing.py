"""Writing with Orbax, whose failures are one line."""

import contextlib
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from logvggt_jax.errors import DiskError, InputError, disk_errors


@contextlib.contextmanager
def writing_with_orbax(path: Path) -> Iterator[None]:
    """Turns the operating system's errors in the block, which writes `path`, into DiskError, as `disk_errors` does;
    those too that Orbax passes on as the text of another exception, after it has logged hundreds of lines of them.

    Orbax waits for the first failure alone. What it has begun beside that ends later, and would then print a traceback
    each: from the first block on nothing is said of it in this process.
    """
    if not isinstance(sys.unraisablehook, _WritesLeftBehind):
        sys.unraisablehook = _WritesLeftBehind(sys.unraisablehook)
    logging.getLogger("asyncio").addFilter(_is_no_write_left_behind)
    logger = logging.getLogger("absl")
    logger.addFilter(_is_not_orbaxs)
    try:
        with disk_errors(path):
            yield
    except InputError:
        raise
    except Exception as error:
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if code is None:
            raise
        raise DiskError(f"{path}: {os.strerror(int(code[1]))}") from error
    finally:
        logger.removeFilter(_is_not_orbaxs)


class _WritesLeftBehind:
    """A hook of the interpreter that passes over writes whose loop, which they report to, is closed."""

    def __init__(self, before: Callable[["sys.UnraisableHookArgs"], Any]) -> None:
        self._before = before

    def __call__(self, unraisable: "sys.UnraisableHookArgs", /) -> Any:
        if not (isinstance(unraisable.exc_value, RuntimeError) and str(unraisable.exc_value) == "Event loop is closed"):
            self._before(unraisable)


def _is_no_write_left_behind(record: logging.LogRecord) -> bool:
    message = record.getMessage()
    left = message.startswith(("Task exception was never retrieved", "Future exception was never retrieved"))
    # Orbax's tasks name its code, the futures of its library the error of the operating system alone.
    return not (left and (f"{os.sep}orbax{os.sep}" in message or "os_error_code=" in message))


def _is_not_orbaxs(record: logging.LogRecord) -> bool:
    return f"{os.sep}orbax{os.sep}" not in record.pathname
