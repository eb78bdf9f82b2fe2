"""Standard streams that a command can rely on: one that is closed, full or gone ends no work and loses no result."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from absl import logging as absl_logging

from logvggt_jax.errors import printable


class ForgivingStream:
    """A text stream whose failures are remembered instead of raised.

    Args:
      stream: the stream; None, as Python has it for a descriptor that was closed, takes everything.

    Attributes:
      failure: the first error of the operating system; None if there was none.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.failure: Exception | None = None

    def write(self, text: str) -> int:
        """Writes what can be written."""
        self._try("write", text)
        return len(text)

    def flush(self) -> None:
        """Flushes if that works."""
        self._try("flush")

    def isatty(self) -> bool:
        """Whether somebody is looking."""
        return self.failure is None and self._stream is not None and self._stream.isatty()

    def _try(self, method: str, *arguments: str) -> None:
        if self._stream is None or self.failure is not None:
            return
        try:
            getattr(self._stream, method)(*arguments)
        except UnicodeEncodeError:
            encoding = self._stream.encoding or "ascii"
            self._try(method, *(text.encode(encoding, "backslashreplace").decode(encoding) for text in arguments))
        except (OSError, ValueError) as error:  # ValueError: the file is closed
            self.failure = error
            self._abandon()

    def _abandon(self) -> None:
        """Whatever is still in the stream's buffer goes nowhere, so that Python does not stumble over it at its end."""
        try:
            assert self._stream is not None
            descriptor = self._stream.fileno()
            nowhere = os.open(os.devnull, os.O_WRONLY)
        except (OSError, ValueError):
            return
        os.dup2(nowhere, descriptor)
        os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def forgiving_streams() -> Iterator[ForgivingStream]:
    """Standard output and standard error forgive while this is entered; gives standard output."""
    _fill_closed_descriptors()
    before = sys.stdout, sys.stderr
    output, errors = ForgivingStream(sys.stdout), ForgivingStream(sys.stderr)
    sys.stdout, sys.stderr = output, errors
    try:
        yield output
    finally:
        output.flush()
        errors.flush()
        sys.stdout, sys.stderr = before


@contextmanager
def plain_warnings(program: str) -> Iterator[None]:
    """Warnings are a line on standard error that begins with the program's name, without the line of code that Python
    shows."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        print(f"{program}: warning: {printable(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def one_log_handler() -> None:
    """Lets absl alone say what is logged, with the time before it.

    Orbax logs while it is imported, for which absl gives Python's logging a handler of its own; the one of `app.run`
    would come beside it, and every warning twice.
    """
    for handler in tuple(logging.root.handlers):
        logging.root.removeHandler(handler)
    absl_logging.use_absl_handler()


def _fill_closed_descriptors() -> None:
    """Puts the null device where a standard descriptor is closed; otherwise the next file that is opened would get its
    number, and what a library prints would be written into it."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
