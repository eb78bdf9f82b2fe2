"""The thread that reads a camera, so that no picture grows old in the camera's own buffers."""

from __future__ import annotations

import threading
import time

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.live.session import LiveSession
from logvggt_jax.reconstruction.sources import Source

# Between two tries to reach a stream that was lost.
_PAUSE = 1.0
# Seconds that a read in progress is given when nothing is wanted any more.
_LEAVE = 1.0
# How soon it is noticed that a video need not go on.
_TICK = 0.05


class Capture:
    """Reads a source in a thread of its own and pushes its frames to a session, until it ends or is told to.

    Args:
      source: the camera, stream or video.
      session: takes the frames.
      realtime: hands out frames no sooner than their time stamps say, as a camera would; what comes after the first one
        waits until the session's programs are there, as a video can.
      reconnect: seconds for which a source that has ended is tried again, since its last frame; None for never.

    Attributes:
      ended: set once nothing more comes.
      reason: why, where the source told; None where it just ended.
    """

    def __init__(
        self, source: Source, session: LiveSession, *, realtime: bool = False, reconnect: float | None = None
    ) -> None:
        self._source, self._session, self._realtime, self._reconnect = source, session, realtime, reconnect
        self.ended = threading.Event()
        self.reason: Exception | None = None
        self._stop = threading.Event()
        self._began = self._last = time.monotonic()
        self._newest = 0.0  # the time stamp that was pushed last
        # A thread that waits for a camera cannot be ended.
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    def start(self) -> None:
        """Begins to read."""
        self._began = self._last = time.monotonic()
        self._thread.start()

    def stop(self) -> None:
        """Nothing is pushed any more; a camera that is silent is not waited for longer than a second."""
        self._stop.set()
        # A process that ends while a thread of it is inside a decoder crashes.
        self._thread.join(_LEAVE)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    self._read()
                    self.reason = None
                except InputError as error:
                    self.reason = error
                if self._session.failed or self._reconnect is None:
                    break
                if time.monotonic() - self._last > self._reconnect:
                    break
                self._stop.wait(_PAUSE)
        except Exception as error:  # told by the main thread
            self.reason = error
        finally:
            self.ended.set()

    def _read(self) -> None:
        """One connection, until its end."""
        asked, offset = time.monotonic(), None
        for load in self._source.loaders():
            frame = load()
            self._session.unreadable += len(self._source.skipped)
            self._source.skipped.clear()
            if frame is None:
                continue
            now = time.monotonic()
            if offset is None and self._session.report().received == 0:
                offset, self._began = 0.0, now - frame.timestamp
            elif offset is None:
                # A stream's own clock may be ahead of ours; time goes on from where it was.
                offset = self._newest + now - self._last - frame.timestamp
            timestamp = self._newest = offset + frame.timestamp
            self._session.times.add("capture", now - asked)
            if self._realtime:
                self._stop.wait(max(0.0, self._began + timestamp - now))
            if self._stop.is_set():
                return
            self._session.push(frame.image, timestamp, frame.mask)
            if self._realtime and not self._session.ready.is_set():
                self._wait_until_ready()
                self._began = time.monotonic() - timestamp
            asked = self._last = time.monotonic()

    def _wait_until_ready(self) -> None:
        while not (self._session.ready.wait(_TICK) or self._stop.is_set()):
            pass
