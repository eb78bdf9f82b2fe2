"""Scalars of a run: JSON lines, TensorBoard and the terminal, written by process 0."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from tensorboardX import SummaryWriter

from logvggt_jax.files import write_text

FILE_NAME = "metrics.jsonl"


class MetricsLog:
    """Appends to `<workdir>/metrics.jsonl` and `<workdir>/tensorboard`; a context manager.

    On a run that resumes at `first_step`, lines of later steps (of the run that was interrupted) are dropped, so
    that the file reads like one uninterrupted run.
    """

    def __init__(self, workdir: Path, *, first_step: int, console: Console, silent: bool = False) -> None:
        """Args: `silent` writes and says nothing, as is right for all processes of a run but the first."""
        self.path = workdir / FILE_NAME
        self.console = console
        self.silent = silent
        if silent:
            return
        workdir.mkdir(parents=True, exist_ok=True)
        _drop_later_lines(self.path, first_step)
        self._file = self.path.open("a")
        self._tensorboard = SummaryWriter(str(workdir / "tensorboard"), purge_step=first_step + 1)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, *_: Any) -> None:
        if not self.silent:
            self._file.close()
            self._tensorboard.close()

    def write(self, step: int, values: dict[str, float]) -> None:
        """Appends one line {"step", "time" (seconds since 1970), …}; non-finite values become null."""
        if self.silent:
            return
        finite = {name: value if math.isfinite(value) else None for name, value in values.items()}
        self._file.write(json.dumps({"step": step, "time": round(time.time(), 3), **finite}) + "\n")
        self._file.flush()
        for name, value in finite.items():
            if value is not None:
                self._tensorboard.add_scalar(name, value, step)

    def say(self, message: str) -> None:
        """One line on the terminal."""
        if not self.silent:
            self.console.print(message, highlight=False, soft_wrap=True)


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a metrics file; an unfinished last line (a killed run) is left out."""
    entries = []
    for line in path.read_text().splitlines():
        try:
            entries.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return entries


def _drop_later_lines(path: Path, last_step: int) -> None:
    if not path.exists():
        return
    kept = [entry for entry in read_metrics(path) if entry["step"] <= last_step]
    write_text(path, "".join(json.dumps(entry) + "\n" for entry in kept))
