"""The folders and text files that a listing is made from, read with their state remembered."""

import re
import stat
from pathlib import Path

from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.errors import InputError

_ABSENT = -1


class SourceFiles:
    """Reads the folders and files that a listing is made from, and remembers their state."""

    def __init__(self) -> None:
        self.states: dict[str, list[int]] = {}

    def names(self, folder: Path, expected: str) -> list[str]:
        """Sorted names in `folder`; MissingFiles saying what was `expected` there."""
        self._note(folder)
        try:
            return sorted(path.name for path in folder.iterdir())
        except (FileNotFoundError, NotADirectoryError) as error:
            raise MissingFiles(f"{folder}: no such folder; expected {expected}") from error

    def folders(self, parent: Path, expected: str, named: re.Pattern[str] | None = None) -> dict[str, Path]:
        """Folders in `parent` by name, sorted, of those with a pattern the ones `named` so; MissingFiles as `names`."""
        chosen = [name for name in self.names(parent, expected) if named is None or named.fullmatch(name)]
        return {name: parent / name for name in chosen if (parent / name).is_dir()}

    def text(self, path: Path, expected: str) -> str:
        """A text file's content; MissingFiles saying what was `expected`, InputError for other bytes."""
        try:
            return self.content(path, expected).decode()
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: not a text file ({error.reason}): fetch it again") from error

    def content(self, path: Path, expected: str) -> bytes:
        """A file's bytes; MissingFiles saying what was `expected`."""
        self._note(path)
        try:
            return path.read_bytes()
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
            raise MissingFiles(f"{path}: no such file; expected {expected}") from error

    def exists(self, path: Path) -> bool:
        """Whether a file or folder is there now."""
        self._note(path)
        return path.exists()

    def _note(self, path: Path) -> None:
        self.states[str(path)] = file_state(path)


def file_state(path: Path) -> list[int]:
    """Time of change and size; a folder's time changes with the names in it."""
    try:
        status = path.stat()
    except OSError:
        return [_ABSENT, _ABSENT]
    return [status.st_mtime_ns, status.st_size if stat.S_ISREG(status.st_mode) else 0]
