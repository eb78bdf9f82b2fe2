"""The folder in which a reconstruction grows, so that a run that ends early can be taken up where it was."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from types import TracebackType

from logvggt_jax.errors import InputError, OutputExists, disk_errors, one_line
from logvggt_jax.files import (
    FolderLock,
    atomic_file,
    check_output,
    move_folder,
    remove_temporary,
    to_disk,
    write_text,
)
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, PARTIAL, is_complete
from logvggt_jax.reconstruction.result_folder import PROGRESS_FOLDER, RESULT
from logvggt_jax.reconstruction.saved_source import check_frames, check_source
from logvggt_jax.reconstruction.sources import Source
from logvggt_jax.streaming.state_file import State, read_state, write_state

_REQUEST, _STATE, _RESERVE = "request.json", "state.safetensors", "reserve"
_MEND = "pass --overwrite to start anew"
_ELSEWHERE = "choose another output"


class WorkFolder:
    """`<output>.partial`, which one run at a time fills and which becomes `output` at the end.

    What was asked for and how far the work has come lie in its `.progress`. The same request takes up what another
    run has left; another request is refused, so that nobody's frames are lost unasked. The lock goes with its process,
    however that ends.

    Args:
      output: absolute path of the result.
      request: what decides the result, names to strings.
      overwrite: begin anew whatever is there, and replace `output` at the end.

    Raises:
      OutputExists: a result is at `output`, or an unfinished one of another request beside it.
      InputError: another run is at work there.
    """

    def __init__(self, output: Path, request: Mapping[str, str], *, overwrite: bool) -> None:
        self._output, self._request, self._overwrite = output, dict(request), overwrite
        self.path = work_path(output)
        self._progress = self.path / PROGRESS_FOLDER
        self._lock: FolderLock | None = None
        # Whether the folder was the incomplete result at `output`, and is still as it was.
        self._unchanged_result = False
        # Whether all is done, and only the place of the result was taken.
        self._refused = False

    def __enter__(self) -> WorkFolder:
        with disk_errors(self.path):
            if not self._overwrite and is_unfinished(self._output) and not self.path.exists():
                _check_request(self._output, self._request)
                self._output.rename(self.path)
                self._unchanged_result = True
            check_output(self._output, overwrite=self._overwrite, kind=RESULT)
            _check_ours(self.path)
        self._lock = FolderLock(self._progress, _ELSEWHERE)
        try:
            with disk_errors(self.path):
                self._take_over()
        except BaseException:
            self._lock.release()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        """Lets go of the folder; without a saved state nobody can use it, and it goes. A result goes back; a new one
        that was refused its place stays."""
        if self._progress.is_dir() and not (self._progress / _STATE).is_file() and not self._refused:
            shutil.rmtree(self.path, ignore_errors=True)
        elif self._unchanged_result and not self._output.exists():
            self.path.rename(self._output)
        if self._lock is not None:
            self._lock.release()

    def _take_over(self) -> None:
        stored = self._progress / _REQUEST
        if stored.exists() and not self._overwrite:
            _check_request(self.path, self._request)
        if self._overwrite or not (self._progress / _STATE).is_file():
            for entry in self.path.iterdir():
                if entry != self._progress:
                    shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            (self._progress / _STATE).unlink(missing_ok=True)
        else:
            remove_temporary(self.path)
        write_text(stored, json.dumps(self._request, indent=1))

    @property
    def found_at(self) -> Path:
        """Where what can be taken up lay, and lies again where it is not taken up."""
        return self._output if self._unchanged_result else self.path

    def go_on(self) -> None:
        """To be called once the saved state is taken over: what is in the folder changes from here on."""
        self._unchanged_result = False

    def saved(self) -> State | None:
        """Where the last `save` was; None for a new run. InputError where the file is damaged."""
        return _saved(self.path)

    def save(self, state: State, files: Iterable[Path]) -> None:
        """Stores where the run is, once what it rests on, `files`, is on the disk."""
        with disk_errors(self.path):
            to_disk(files)
        write_state(self._progress / _STATE, state)

    def reserve(self, size: int) -> Path:
        """A file that takes up so many bytes of the disk until it is removed; `commit` of a complete result does."""
        file = self._progress / _RESERVE
        with atomic_file(file) as temporary:
            temporary.write_bytes(os.urandom(size))  # nothing that a file system could make smaller
        return file

    def commit(self, *, complete: bool) -> None:
        """Puts the folder in the result's place; an incomplete one can still be taken up."""
        with disk_errors(self._output):
            try:
                check_output(self._output, overwrite=self._overwrite, kind=RESULT)
            except OutputExists as error:  # what is in the way came while the run was at work
                self._refused = True
                raise OutputExists(
                    f"{error}; the new result is whole in {self.path}: give that folder another name, since the same "
                    "command would begin anew"
                ) from error
            move_folder(self.path, self._output, replace=self._overwrite)
        if complete:
            shutil.rmtree(self._output / PROGRESS_FOLDER, ignore_errors=True)


def work_path(output: Path) -> Path:
    """Where the work on a result lies until it is finished."""
    return output.with_name(output.name + PARTIAL)


def is_unfinished(folder: Path) -> bool:
    """Whether a result folder was left early and can be taken up."""
    with disk_errors(folder):
        return (folder / PROGRESS_FOLDER / _STATE).is_file() and not is_complete(folder / CAMERAS_FILE)


def check_leftovers(output: Path, request: Mapping[str, str], source: Source, *, overwrite: bool) -> None:
    """Raises what a `WorkFolder` and a run over `source` would for what another run has left or is at work on, as far
    as that can be known without the weights: `request` lacks them and their precision; nothing is taken over."""
    path = work_path(output)
    with disk_errors(path):
        _check_ours(path)
        if (path / PROGRESS_FOLDER).is_dir():
            FolderLock(path / PROGRESS_FOLDER, _ELSEWHERE).release()
        unfinished = path if path.exists() else output
        if not overwrite and (unfinished / PROGRESS_FOLDER / _REQUEST).exists():
            _check_request(unfinished, request, unknown=("weights", "precision"))
            if (saved := _saved(unfinished)) is not None:
                check_source(source, saved.facts, unfinished)
                check_frames(saved, unfinished)


def _saved(folder: Path) -> State | None:
    file = folder / PROGRESS_FOLDER / _STATE
    if not file.is_file():
        return None
    try:
        return read_state(file)
    except InputError as error:
        raise InputError(f"{error}; {_MEND}") from error


def _check_ours(path: Path) -> None:
    if path.exists() and not (path / PROGRESS_FOLDER).is_dir() and (not path.is_dir() or any(path.iterdir())):
        raise OutputExists(f"{path} is in the way and was not made by this program: move it elsewhere")


def _check_request(folder: Path, request: Mapping[str, str], unknown: Collection[str] = ()) -> None:
    file = folder / PROGRESS_FOLDER / _REQUEST
    try:
        stored = json.loads(file.read_text("utf-8"))
        names = (stored.keys() | request.keys()).difference(unknown)
        others = sorted(name for name in names if stored.get(name) != request.get(name))
    except (ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"{file}: damaged ({one_line(error)}); {_MEND}") from error
    if others:
        raise OutputExists(
            f"{folder} holds an unfinished reconstruction that differs in {', '.join(others)}; give its options to go "
            f"on with it, choose another output, or {_MEND}"
        )
