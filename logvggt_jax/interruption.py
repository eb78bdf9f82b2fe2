"""Signals that end a run, taken as a request to stop at the next good place."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit code of what Ctrl-C ended, as shells count it."""


class Interrupted(Exception):
    """A signal ended a run; `signal` is its name, and the message says what is left and how to go on."""

    def __init__(self, signal_name: str, message: str) -> None:
        super().__init__(message)
        self.signal = signal_name


class StopRequest:
    """While entered, the first of some signals sets `reason` to its name; a second one acts as usual.

    Signals can only be caught in the main thread; elsewhere this does nothing. A signal that the process was told to
    ignore, as SIGHUP is under nohup, stays ignored.

    Args:
      names: of the signals; those that the operating system lacks are left out.
    """

    def __init__(self, *names: str) -> None:
        self.reason: str | None = None
        self._numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in self._numbers:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: Any) -> None:
        self._restore()

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.reason = signal.Signals(number).name
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()


@contextlib.contextmanager
def one_line_at_ctrl_c(program: str) -> Iterator[None]:
    """While entered, Ctrl-C ends `program` with one line and the code `INTERRUPTED`, where what runs lets it pass.

    It does so at once while modules are imported: libraries take a KeyboardInterrupt in the middle of their extensions
    for an error of their own, crash, or forget it. When all is done, and libraries clean up, it ends the process
    without a word. Outside of the main thread that does not work, nor where something else handles the signal, or it
    is ignored.
    """
    line = f"{program}: interrupted"

    def end(number: int, frame: FrameType | None) -> None:
        if _importing(frame):
            with contextlib.suppress(OSError, ValueError):  # nobody may be reading
                sys.stdout.flush()
                print(line, file=sys.stderr, flush=True)
            os._exit(INTERRUPTED)
        signal.default_int_handler(number, frame)

    ours = threading.current_thread() is threading.main_thread()
    ours = ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, end)
    try:
        yield
    except KeyboardInterrupt:
        print(line, file=sys.stderr)
        sys.exit(INTERRUPTED)
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            # Nothing is left to be done but what libraries clean up, JAX for a second: that would be a traceback.
            atexit.register(_end_at_once)


def _end_at_once() -> None:
    """Lets Ctrl-C end the process from here on, unless somebody else handles it by now."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported: the import system is at work, or a module's own lines between imports."""
    if frame is not None and frame.f_code.co_name == "<module>":
        return True
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("importlib._bootstrap"):
            return True
        frame = frame.f_back
    return False
