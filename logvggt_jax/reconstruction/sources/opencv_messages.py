"""What OpenCV and its libraries print: hidden where it says nothing new, read where it is said in no other way."""

import contextlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator

import cv2

_STDERR = threading.RLock()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without OpenCV's warnings: an error says the same."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextlib.contextmanager
def captured_stderr() -> Iterator[Callable[[], str]]:
    """What libraries print to standard error in the block: OpenCV hands out errors in no other way.

    Gives a function that returns what has been printed so far; nothing of it reaches the terminal.
    """
    # The descriptor is the whole process's: two threads would restore it out of turn.
    with _STDERR:
        sys.stderr.flush()
        kept = os.dup(2)
        try:
            with tempfile.TemporaryFile() as file:
                os.dup2(file.fileno(), 2)
                try:

                    def printed() -> str:
                        file.seek(0)
                        return file.read().decode(errors="replace")

                    yield printed
                finally:
                    os.dup2(kept, 2)
        finally:
            os.close(kept)
