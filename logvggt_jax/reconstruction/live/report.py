"""How a live session keeps up: counts of frames, and how long every stage took."""

from __future__ import annotations

import dataclasses
import io
import threading
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

# The stages with what each of them is.
STAGES = {
    "capture": "asking the camera until the picture is here; its next exposure is waited for",
    "wait": "in the queue until the session takes the frame",
    "resize": "to the model's size",
    "device": "a window, from its last frame until its results are on the host",
    "result": "handing on a window's frames: files, and what is called with them",
    "final": "a frame from its picture until it was handed on, later frames of its windows included",
}
# Measurements of a stage that are kept: the newest.
_KEPT = 1000


class StageTimes:
    """The newest thousand measurements of every stage, in seconds. Any thread may add and read."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {name: deque(maxlen=_KEPT) for name in STAGES}
        self._lock = threading.Lock()

    def add(self, stage: str, seconds: float) -> None:
        """One more measurement of a stage of `STAGES`."""
        with self._lock:
            self._times[stage].append(seconds)

    def latencies(self) -> dict[str, Latency]:
        """Of the stages that were measured, in order."""
        with self._lock:
            times = {name: np.array(values) for name, values in self._times.items() if values}
        return {
            name: Latency(float(np.median(values)), float(np.percentile(values, 95)), len(values))
            for name, values in times.items()
        }


class Latency(NamedTuple):
    """Of one stage: median and 95 % quantile in seconds, and how many measurements there are."""

    median: float
    most: float
    measured: int


@dataclasses.dataclass(frozen=True)
class LiveReport:
    """How a live session has kept up so far.

    Attributes:
      received: frames that came; those that wait besides, all were used or dropped.
      used: frames that went into windows.
      dropped: frames that newer ones pushed out of the queue, or that came while the programs were compiled.
      waiting: frames in the queue.
      unreadable: frames that the source could not decode; they are in no other count.
      finished: frames whose depth is final and that were handed on.
      fps: frames used a second, over the newest hundred; None before there are five.
      latencies: of the stages of `STAGES` that were measured, over the newest thousand measurements.
    """

    received: int
    used: int
    dropped: int
    waiting: int
    unreadable: int
    finished: int
    fps: float | None
    latencies: dict[str, Latency]

    def line(self) -> str:
        """Everything on one line: medians, and 95 % quantiles in brackets, in milliseconds."""
        stages = (f"{name} {1e3 * t.median:.0f} ({1e3 * t.most:.0f})" for name, t in self.latencies.items())
        parts = [f"{self.received} in, {self.used} used, {self.dropped} dropped"]
        if self.fps is not None:
            parts.append(f"{self.fps:.1f} fps")
        if self.latencies:
            parts.append(f"ms: {', '.join(stages)}")
        return " | ".join(parts)

    def table(self) -> str:
        """Counts, and a row a stage."""
        table = Table("stage", "median ms", "95 % ms", "measured", "what it is", box=None, pad_edge=False)
        for column in table.columns[1:4]:
            column.justify = "right"
        for name, times in self.latencies.items():
            table.add_row(
                name, f"{1e3 * times.median:.1f}", f"{1e3 * times.most:.1f}", str(times.measured), STAGES[name]
            )
        text = io.StringIO()
        Console(file=text, width=120).print(table)
        unreadable = f", {self.unreadable} that could not be read" if self.unreadable else ""
        waiting = f", {self.waiting} waiting" if self.waiting else ""
        rate = "" if self.fps is None else f"; {self.fps:.1f} frames a second"
        counts = f"{self.received} frames in: {self.used} used, {self.dropped} dropped{waiting}{unreadable}{rate}\n"
        return counts + "\n".join(line.rstrip() for line in text.getvalue().splitlines())

    def as_json(self) -> dict[str, Any]:
        """The same as JSON takes it; seconds."""
        values = dataclasses.asdict(self)
        values["latencies"] = {name: times._asdict() for name, times in self.latencies.items()}
        return values
