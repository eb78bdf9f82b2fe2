"""One case: a copy of a valid input, damaged, read, and the outcome judged."""

from __future__ import annotations

import os
import shutil
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fuzzing.damages import damage
from logvggt_jax.errors import InputError

NOTE = "damage.txt"  # what was done, for whoever finds the case's folder left behind


class Nonsense(Exception):
    """What a reader gave is no result: not finite, of another shape, silently less than there was."""


@dataclass(frozen=True)
class Kind:
    """A kind of input.

    Attributes:
      name: for the command line.
      write: puts a small valid input into an empty folder.
      read: reads what is in a folder by the entry that users reach; a second folder is for what it writes. Raises
        InputError for what cannot be used, Nonsense where that was not noticed.
    """

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path, Path], object]


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
      kind, seed: which case.
      verdict: `result` or `line`, which are right; `exception`, `message`, `nonsense`, `hang` or `crash`.
      damage: what was done.
      detail: the message.
      trace: where it arose.
    """

    kind: str
    seed: int
    verdict: str
    damage: str = ""
    detail: str = ""
    trace: str = ""

    @property
    def failed(self) -> bool:
        """Whether something is to be mended."""
        return self.verdict not in ("result", "line")


def run_case(kind: Kind, valid: Path, folder: Path, seed: int, keep: Path | None = None) -> Outcome:
    """Damages a copy of the input in `valid` and reads it; the copy is made in `folder`, and removed again.

    Copies of failures are moved to the folder `keep`.
    """
    root, output = folder / "input", folder / "output"
    shutil.copytree(valid, root, symlinks=True)
    output.mkdir()
    try:
        done = damage(root, np.random.default_rng(seed))
        (folder / NOTE).write_text(done)
        outcome = judge(kind, root, output, seed, done)
        if outcome.failed and keep is not None:
            keep_input(root, keep, kind.name, seed)
        return outcome
    finally:
        remove_tree(folder)


def remove_tree(folder: Path) -> None:
    """Removes a folder with all in it, also that from which permissions were taken."""
    for inner, names, _ in os.walk(folder):
        for name in names:
            (Path(inner) / name).chmod(0o700)
    shutil.rmtree(folder, ignore_errors=True)


def keep_input(root: Path, keep: Path, kind: str, seed: int) -> None:
    """Moves a damaged input to a folder of such, under a name that says which it is."""
    target = keep / f"{kind}-{seed}"
    shutil.rmtree(target, ignore_errors=True)
    keep.mkdir(parents=True, exist_ok=True)
    shutil.move(root, target)


def judge(kind: Kind, root: Path, output: Path, seed: int, done: str) -> Outcome:
    """Reads a damaged input and says how that ended."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            kind.read(root, output)
    except InputError as error:
        message = str(error)
        # A line of a message that names no file sends the user searching.
        verdict = "line" if str(root) in message and "\n" not in message else "message"
        return Outcome(kind.name, seed, verdict, done, f"{type(error).__name__}: {message}", _trace(error))
    except Nonsense as error:
        return Outcome(kind.name, seed, "nonsense", done, str(error), "")
    except Exception as error:  # a harness has to see them all
        return Outcome(kind.name, seed, "exception", done, f"{type(error).__name__}: {error}", _trace(error))
    return Outcome(kind.name, seed, "result", done)


def _trace(error: BaseException) -> str:
    """The innermost places in this package that an error passed."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "logvggt_jax" in frame.filename]
    return " < ".join(f"{Path(frame.filename).name}:{frame.lineno} {frame.name}" for frame in reversed(frames[-4:]))
