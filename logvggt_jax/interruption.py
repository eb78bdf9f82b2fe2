"""Signals that end a run, taken as a request to stop at the next good place."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any


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
