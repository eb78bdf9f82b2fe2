"""`train.py` and `eval.py` as users start them, but from one interpreter that has their libraries: each run is a fork
of it, so that what takes seconds to import is imported once."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]

# A fork leaves the loop, so that its end is the interpreter's own: exit codes, messages and tracebacks as ever.
_SERVER = """
import importlib, json, os, runpy, signal, sys, warnings
for library in sys.argv[1:]:
    importlib.import_module(library)
warnings.filterwarnings("ignore", message=r".*os\\.fork")
arguments = None
for line in sys.stdin:
    arguments, output, error = json.loads(line)
    child = os.fork()
    if child == 0:
        signal.alarm(600)  # what hangs is killed
        for number, file in ((1, output), (2, error)):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    arguments = None
if arguments is not None:
    sys.argv = arguments
    sys.path.insert(0, os.getcwd())
    runpy.run_path(arguments[0], run_name="__main__")
"""


class RootPrograms:
    """Runs one program after the other; see `loaded`."""

    def __init__(self, server: subprocess.Popen[str], folder: Path) -> None:
        self._server, self._folder = server, folder

    def __call__(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """The program `arguments[0]` of the root with its arguments, once it has ended."""
        assert self._server.stdin is not None and self._server.stdout is not None
        files = self._folder / "output", self._folder / "error"
        self._server.stdin.write(json.dumps([arguments, *map(str, files)]) + "\n")
        self._server.stdin.flush()
        code = int(self._server.stdout.readline())
        return subprocess.CompletedProcess(arguments, code, *(file.read_text() for file in files))


@contextmanager
def loaded(folder: Path, *libraries: str) -> Iterator[RootPrograms]:
    """An interpreter with these modules imported, none of which may have started a device."""
    command = [sys.executable, "-c", _SERVER, *libraries]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        yield RootPrograms(server, folder)
        assert server.stdin is not None
        server.stdin.close()
