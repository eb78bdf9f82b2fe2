"""`train.py` and `eval.py` as users start them, but from one interpreter that has their libraries: each run is a fork
of it, so that what takes seconds to import is imported once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]

# A fork leaves the loop, so that its end is the interpreter's own: exit codes, messages and tracebacks as ever.
_SERVER = """
import gc
gc.set_threshold(100_000, 50, 100)  # as in `conftest.py`
import importlib, json, os, runpy, signal, sys, warnings
for library in sys.argv[1:]:
    importlib.import_module(library)
# What all forks share stays: no fork walks through a third of a million objects at its end to free them.
gc.collect()
gc.freeze()
warnings.filterwarnings("ignore", message=r".*os\\.fork")
order = None
for line in sys.stdin:
    order = json.loads(line)
    if isinstance(order, int):
        print(os.waitstatus_to_exitcode(os.waitpid(order, 0)[1]), flush=True)
        order = None
        continue
    child = os.fork()
    if child == 0:
        signal.alarm(600)  # what hangs is killed
        for number, file in ((1, order["output"]), (2, order["error"])):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
        break
    print(child, flush=True)
    order = None
if order is not None:
    sys.argv = order["arguments"]
    sys.path.insert(0, os.getcwd())
    exec(order["first"], {})
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


class Running:
    """A program that has been started; what it prints goes to the files `output` and `error`."""

    def __init__(self, pid: int, output: Path, error: Path, ended: Callable[[int], int]) -> None:
        self.output, self.error = output, error
        self.returncode: int | None = None
        self._pid, self._ended = pid, ended

    def wait(self) -> int:
        """Its exit code, once it has ended."""
        if self.returncode is None:
            self.returncode = self._ended(self._pid)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Nothing once it was waited for: its number may be another's by then."""
        if self.returncode is None:
            os.kill(self._pid, number)


class RootPrograms:
    """Runs programs; see `loaded`."""

    def __init__(self, server: subprocess.Popen[str], folder: Path) -> None:
        self._server, self._folder, self._count = server, folder, 0

    def start(self, *arguments: str, first: str = "") -> Running:
        """The program `arguments[0]` of the root with its arguments; `first` are Python statements to run before."""
        self._count += 1
        output, error = (self._folder / f"{self._count}.{name}" for name in ("output", "error"))
        order = {"arguments": arguments, "first": first, "output": str(output), "error": str(error)}
        return Running(self._ask(order), output, error, self._ask)

    def __call__(self, *arguments: str, first: str = "") -> subprocess.CompletedProcess[str]:
        """The same, once it has ended."""
        run = self.start(*arguments, first=first)
        return subprocess.CompletedProcess(arguments, run.wait(), run.output.read_text(), run.error.read_text())

    def _ask(self, order: dict | int) -> int:
        assert self._server.stdin is not None and self._server.stdout is not None
        self._server.stdin.write(json.dumps(order) + "\n")
        self._server.stdin.flush()
        return int(self._server.stdout.readline())


@contextmanager
def loaded(folder: Path, *libraries: str) -> Iterator[RootPrograms]:
    """An interpreter with these modules imported, none of which may have started a device."""
    command = [sys.executable, "-c", _SERVER, *libraries]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        yield RootPrograms(server, folder)
        assert server.stdin is not None
        server.stdin.close()
