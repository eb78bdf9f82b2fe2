"""The file of scalars and pictures that TensorBoard reads."""

from __future__ import annotations

import contextlib
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from tensorboardX import summary
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.record_writer import RecordWriter

from logvggt_jax.errors import disk_errors

_FLUSH_SECONDS = 60.0


class EventFile:
    """A new file of events in `folder`, which TensorBoard shows in the place of earlier events from `purge_step` on.

    It is written by the thread that calls, not by the library's own: that one ends at the first error of the disk,
    which nobody hears of, and whoever has ten more events then waits for it for ever. Raises DiskError where the file
    cannot be written.
    """

    def __init__(self, folder: Path, *, purge_step: int) -> None:
        self._folder = folder
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            name = f"events.out.tfevents.{time.time():.0f}.{platform.node()}.{os.getpid()}"
            self._records = RecordWriter(str(folder / name))
        self._flush_at = time.monotonic()
        self._write(Event(step=purge_step, file_version="brain.Event:2"))
        self._write(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))

    def add_scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Numbers of `step` by name, all of them one event: the checksum of each is made in Python."""
        scalars = [summary.scalar(name, value).value[0] for name, value in values.items()]
        self._write(Event(step=step, summary=summary.Summary(value=scalars)))

    def add_picture(self, step: int, name: str, picture: np.ndarray) -> None:
        """A picture of `step`, [h, w, 3] uint8 RGB."""
        self._write(Event(step=step, summary=summary.image(name, picture, dataformats="HWC")))

    def close(self) -> None:
        """Ends the file; a disk that does not take the rest has been told of, or loses pictures and no more."""
        with contextlib.suppress(OSError):
            self._records.close()

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        with disk_errors(self._folder):
            self._records.write(event.SerializeToString())
            if time.monotonic() >= self._flush_at:
                self._records.flush()
                self._flush_at = time.monotonic() + _FLUSH_SECONDS
