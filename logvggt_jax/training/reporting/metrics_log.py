"""Scalars and pictures of a run: JSON lines, TensorBoard and the terminal, written by process 0."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from logvggt_jax.errors import disk_errors
from logvggt_jax.files import write_text
from logvggt_jax.training.reporting.event_file import EventFile
from logvggt_jax.training.reporting.wandb_run import WandbRun

FILE_NAME = "metrics.jsonl"
# Beside the metrics, whose file is the same, byte by byte, however often a run was killed.
TIMES_NAME = "times.jsonl"
# What one validation, save, … takes is in `times.jsonl` as `seconds_of/validation`, ….
COST = "seconds_of/"
# By so much at least the clock of the day departs from one that nobody sets where it was set.
_SET_SECONDS = 60.0
_CLOCK_SET = "clock_set_by"


class MetricsLog:
    """Appends to `metrics.jsonl`, `times.jsonl` and `tensorboard/` of a work folder; a context manager.

    Attributes:
      productive_seconds: what earlier starts spent on the steps that are left of them.
      costs: seconds that one validation, save, … took in the last of them.

    On a run that resumes at `first_step`, lines of later steps (of the run that was interrupted) are dropped, so
    that the file reads like one uninterrupted run; on one that begins `anew`, perhaps with other settings, the metrics
    of step 0 too. Raises DiskError where one of the files cannot be written, at once: a run whose metrics have a hole
    is not one that was left alone.
    """

    def __init__(
        self,
        workdir: Path,
        *,
        first_step: int,
        anew: bool = False,
        console: Console,
        silent: bool = False,
        wandb: WandbRun | None = None,
    ) -> None:
        """Args: `silent` writes and says nothing, as is right for all processes of a run but the first; `wandb` gets
        what TensorBoard gets."""
        self.path = workdir / FILE_NAME
        self.console = console
        self.silent = silent
        self._wandb = wandb
        self.productive_seconds = 0.0
        self.costs: dict[str, float] = {}
        self._started = self._opened = time.time()
        self._opened_steadily = _steady_time()
        self._was_set = False
        if silent:
            return
        times = workdir / TIMES_NAME
        with disk_errors(workdir):
            workdir.mkdir(parents=True, exist_ok=True)
            earlier = read_metrics(times) if times.exists() else []
            _drop_lines(self.path, beginning=0 if anew else first_step + 1)
            # The goodput counts from the first start, whatever its settings were.
            _drop_lines(times, beginning=first_step + 1)
            # Without a buffer, which would fail once more when it is closed.
            self._file, self._times = self.path.open("ab", buffering=0), times.open("ab", buffering=0)
        self._events = EventFile(workdir / "tensorboard", purge_step=0 if anew else first_step + 1)
        kept = [entry for entry in earlier if entry["step"] <= first_step]
        known = [entry for entry in kept if {"time", "productive_seconds"} <= entry.keys()]
        if known:
            self._started = known[0]["time"]
            self.productive_seconds = known[-1]["productive_seconds"]
            costs = {name.removeprefix(COST): value for name, value in known[-1].items() if name.startswith(COST)}
            self.costs = {kind: value for kind, value in costs.items() if value is not None}
        else:
            self.write_times(first_step, {"productive_seconds": 0.0})
        set_by = [entry[_CLOCK_SET] for entry in earlier if _CLOCK_SET in entry]
        self._was_set = bool(set_by)
        # What a lost step's line said of the clock stays true.
        if set_by and not any(_CLOCK_SET in entry for entry in kept):
            self.write_times(first_step, {"productive_seconds": self.productive_seconds, _CLOCK_SET: set_by[-1]})

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, *_: Any) -> None:
        if not self.silent:
            self._file.close()
            self._times.close()
            self._events.close()

    def write(self, step: int, values: Mapping[str, float], **words: str) -> None:
        """Appends one line {"step", …}; non-finite values become null. Only the line has the `words`."""
        if not self.silent:
            self._append(self._file, {"step": step, **_finite(values), **words})
            self._draw(step, values)

    def write_times(self, step: int, values: dict[str, float]) -> None:
        """The same for what differs from one machine and start to the next, in a file of its own, with `time`
        (seconds since 1970), and where the clock was set since this start by how many seconds."""
        if not self.silent:
            jump = self._clock_jump()
            was_set = {_CLOCK_SET: round(jump, 3)} if abs(jump) > _SET_SECONDS else {}
            self._append(self._times, {"step": step, "time": round(time.time(), 3), **was_set, **_finite(values)})
            self._draw(step, {f"times/{name}": value for name, value in values.items()})

    def seconds_since_start(self) -> float | None:
        """Since the run began for the first time, by the clock of the day; None where that was set within a start."""
        if self._was_set or abs(self._clock_jump()) > _SET_SECONDS:
            return None
        return time.time() - self._started

    def _clock_jump(self) -> float:
        """Seconds by which the clock of the day was set since this start of the run."""
        return (time.time() - self._opened) - (_steady_time() - self._opened_steadily)

    def show(self, step: int, pictures: Mapping[str, np.ndarray]) -> None:
        """Pictures by name, [h, w, 3] uint8 RGB."""
        if self.silent:
            return
        for name, picture in pictures.items():
            self._events.add_picture(step, name, picture)
        if self._wandb is not None:
            self._wandb.show(step, pictures)

    def _append(self, file: FileIO, entry: Mapping[str, Any]) -> None:
        line = (json.dumps(entry) + "\n").encode()
        with disk_errors(file.name):
            while line:  # what a disk takes before it is full is no error
                line = line[file.write(line) :]
            # Before the checkpoint of its step: after a loss of power there would be a hole.
            os.fsync(file.fileno())

    def _draw(self, step: int, values: Mapping[str, float]) -> None:
        finite = {name: value for name, value in values.items() if math.isfinite(value)}
        if finite:
            self._events.add_scalars(step, finite)
        if self._wandb is not None:
            self._wandb.write(step, finite)

    def say(self, message: str) -> None:
        """One line on the terminal."""
        if not self.silent:
            self.console.print(message, highlight=False, markup=False, soft_wrap=True)


def _steady_time() -> float:
    """Seconds by a clock that nobody sets and that, where the system has one, goes on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


def _finite(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a metrics file; what is none is left out: the unfinished last one of a killed run, damaged ones."""
    entries = []
    for line in path.read_bytes().splitlines():
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(entry, dict) and isinstance(entry.get("step"), int):
            entries.append(entry)
    return entries


def _drop_lines(path: Path, *, beginning: int) -> None:
    """Leaves the lines of the steps before `beginning`."""
    if not path.exists():
        return
    kept = [entry for entry in read_metrics(path) if entry["step"] < beginning]
    write_text(path, "".join(json.dumps(entry) + "\n" for entry in kept))
