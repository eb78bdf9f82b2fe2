"""Cases in worker processes: one that hangs or dies is noticed, and its worker replaced."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import shutil
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path

from fuzzing.cases import NOTE, Kind, Outcome, keep_input, remove_tree, run_case

_MEMORY = 16 * 2**30  # address space of a worker: what asks for more has believed a damaged number
_PREPARATION = 300.0  # seconds, for imports and the valid inputs
_READY = "ready"


def run_cases(
    kinds: Sequence[Kind],
    cases: Iterable[tuple[str, int]],
    folder: Path,
    *,
    workers: int = 2,
    limit: float = 20.0,
    keep: Path | None = None,
) -> Iterator[Outcome]:
    """Outcomes of cases (kind's name and seed), as they come.

    Args:
      kinds: the kinds that cases name; functions of modules that a new process can import.
      cases: what is run.
      folder: for all that is written.
      workers: processes.
      limit: seconds that a case may take.
      keep: where inputs of failures go; None keeps none.
    """
    remaining = iter(cases)
    pool = [_Worker(kinds, folder / f"worker-{number}", limit, keep) for number in range(workers)]
    try:
        busy = [worker for worker in pool if worker.begin(next(remaining, None))]
        while busy:
            wait([worker.connection for worker in busy], timeout=0.5)
            for worker in busy:
                if (outcome := worker.poll()) is not None:
                    yield outcome
                    worker.begin(next(remaining, None))
            busy = [worker for worker in busy if worker.case is not None]
    finally:
        for worker in pool:
            worker.stop()


class _Worker:
    """A process and the case that it is at."""

    def __init__(self, kinds: Sequence[Kind], folder: Path, limit: float, keep: Path | None) -> None:
        self._kinds, self._folder, self._limit, self._keep = kinds, folder, limit, keep
        self.case: tuple[str, int] | None = None
        self._start()

    def begin(self, case: tuple[str, int] | None) -> bool:
        """Takes the next case; False where there is none."""
        self.case = case
        if case is not None:
            self._deadline = time.monotonic() + _PREPARATION
            self.connection.send(case)
        return case is not None

    def poll(self) -> Outcome | None:
        """The outcome, where there is one by now."""
        assert self.case is not None
        kind, seed = self.case
        try:
            while self.connection.poll():
                answer = self.connection.recv()
                if isinstance(answer, Outcome):
                    return answer
                self._deadline = time.monotonic() + self._limit
        except (EOFError, ConnectionError):
            self._process.join()
            return self._replaced(Outcome(kind, seed, "crash", detail=f"exit code {self._process.exitcode}"))
        if time.monotonic() > self._deadline:
            return self._replaced(Outcome(kind, seed, "hang", detail=f"no end after {self._limit:g} s"))
        return None

    def stop(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.join()
        self.connection.close()
        remove_tree(self._folder)

    def _replaced(self, outcome: Outcome) -> Outcome:
        self._process.kill()
        self._process.join()
        root = self._folder / "case" / "input"
        done = _noted(self._folder)
        if self._keep is not None and root.is_dir():
            keep_input(root, self._keep, outcome.kind, outcome.seed)
        self.stop()
        self._start()
        return Outcome(outcome.kind, outcome.seed, outcome.verdict, done, outcome.detail)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        arguments = (theirs, list(self._kinds), self._folder, self._keep)
        self._process = context.Process(target=_work, args=arguments, daemon=True)
        self._process.start()
        theirs.close()


def _work(connection: Connection, kinds: list[Kind], folder: Path, keep: Path | None) -> None:
    """A worker's life: cases in, outcomes out."""
    folder.mkdir(parents=True, exist_ok=True)
    # Libraries complain of what they meet; that is not what is looked for.
    with (folder / "output.txt").open("w") as silent:
        os.dup2(silent.fileno(), 1)
        os.dup2(silent.fileno(), 2)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    by_name = {kind.name: kind for kind in kinds}
    while True:
        try:
            name, seed = connection.recv()
        except EOFError:
            return
        kind, valid = by_name[name], folder / "valid" / name
        if not valid.exists():
            try:
                _prepare(kind, valid)
            except Exception as error:
                shutil.rmtree(valid)
                connection.send(Outcome(name, seed, "exception", "none", f"the valid input is not read: {error!r}"))
                continue
        connection.send(_READY)
        try:
            outcome = run_case(kind, valid, folder / "case", seed, keep)
        except Exception:
            outcome = Outcome(name, seed, "exception", detail=f"the harness itself: {traceback.format_exc()}")
        connection.send(outcome)
        shutil.rmtree(folder / "cache", ignore_errors=True)


def _prepare(kind: Kind, valid: Path) -> None:
    """Writes the valid input and reads it once, with all imports that this needs."""
    valid.mkdir(parents=True)
    kind.write(valid)
    output = valid.with_name(f"{valid.name} output")
    output.mkdir()
    kind.read(valid, output)
    shutil.rmtree(output)


def _noted(folder: Path) -> str:
    with contextlib.suppress(OSError):
        return (folder / "case" / NOTE).read_text()
    return ""
