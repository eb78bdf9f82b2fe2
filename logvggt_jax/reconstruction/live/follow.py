"""A camera followed until it or its user ends it, with a line that says how the session keeps up."""

from __future__ import annotations

import sys
import warnings

from logvggt_jax.errors import InputError
from logvggt_jax.interruption import Interrupted, StopRequest
from logvggt_jax.reconstruction.live.capture import Capture
from logvggt_jax.reconstruction.live.session import LiveSession
from logvggt_jax.reconstruction.sources import Source

# Seconds between two lines: drawn over one another on a terminal, one below the other elsewhere.
_ON_TERMINALS, _ELSEWHERE = 0.5, 10.0
# How soon a signal is noticed.
_TICK = 0.05


def check_answers(source: Source) -> None:
    """Opens a camera or stream and looks at one frame, so that a wrong address is told before anything is loaded.

    Raises:
      InputError: it cannot be opened, or gives no frame.
    """
    if next(source.loaders(), None) is None:
        raise InputError(f"{source.name} gave no frame")


def follow(
    source: Source,
    session: LiveSession,
    *,
    realtime: bool = False,
    reconnect: float | None = None,
    progress: bool = True,
) -> str | None:
    """Feeds a camera to a session and leaves it; what is final by then is kept in every case.

    In the main thread Ctrl-C, SIGTERM and SIGHUP end the sequence; a second signal acts as usual, but what was final is
    kept even then if it is Ctrl-C.

    Args:
      source: the camera, stream or video.
      session: that was not entered yet.
      realtime: play a video at its own pace; its end is no loss.
      reconnect: seconds for which a stream that was lost is tried again.
      progress: say on standard error how the session keeps up.

    Returns:
      Why the camera was lost, in one line; None where the user ended the sequence, or the video its own.

    Raises:
      InputError: not one frame came.
      Interrupted: the user ended it before one did.
      Exception: what went wrong in the session, or in the source; what was final is kept.
    """
    lost: str | None = None
    broken: Exception | None = None
    capture = Capture(source, session, realtime=realtime, reconnect=reconnect)
    with StopRequest("SIGINT", "SIGTERM", "SIGHUP") as stop, session:
        capture.start()
        status = _Status(session, shown=progress)
        try:
            while not (stop.reason or session.failed or capture.ended.wait(_TICK)):
                status.tick()
        finally:
            capture.stop()
            status.end()
        if not (stop.reason or session.failed):
            if capture.reason is not None and not isinstance(capture.reason, InputError):
                broken = capture.reason
            elif capture.reason is not None or not realtime:
                reason = str(capture.reason or "no more frames come; is it still connected?")
                never = capture.reason is not None and session.report().received == 0
                lost = reason if never else f"{source.name} is lost: {reason.removeprefix(source.name).lstrip(': ')}"
            session.complete = broken is None and lost is None
        session.signal = stop.reason
    if broken is not None:
        if session.reconstruction is not None:
            warnings.warn(f"what was seen before is kept in {session.reconstruction.folder}", stacklevel=2)
        raise broken
    if session.report().received == 0:
        if stop.reason is not None:
            raise Interrupted(stop.reason, "no frame had come yet")
        raise InputError(lost or f"{source.name} gave no frame")
    return lost


class _Status:
    def __init__(self, session: LiveSession, *, shown: bool) -> None:
        self._session, self._shown = session, shown
        self._terminal = sys.stderr.isatty()
        self._ticks, self._every = 0, round((_ON_TERMINALS if self._terminal else _ELSEWHERE) / _TICK)

    def tick(self) -> None:
        """Shows the line if it is time."""
        self._ticks += 1
        if self._shown and self._ticks % self._every == 0:
            print(*self._around(self._session.report().line()), sep="", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Leaves the line where it is."""
        if self._shown and self._terminal:
            print(file=sys.stderr)

    def _around(self, line: str) -> tuple[str, ...]:
        return ("\r", line, "\x1b[K") if self._terminal else ("logvggt: ", line, "\n")
