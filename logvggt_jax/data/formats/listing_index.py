"""Listings of data sets kept on disk: the second start does not walk a million files again.

A listing remembers the state of every folder and file that it was made from. While those are unchanged it is taken
from the index, else made anew. The index is a cache: where it cannot be written, data sets work without it.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from contextlib import closing
from pathlib import Path

from absl import logging

from logvggt_jax.files import user_cache_folder

FORMAT = 2  # part of every index's name; raise it whenever the same files give other listings or other bytes
_TIMEOUT = 30.0  # seconds to wait for another process that writes
_ABSENT = -1
_TABLE = "CREATE TABLE IF NOT EXISTS listings (key TEXT PRIMARY KEY, count INTEGER, sources TEXT, payload BLOB)"


class SourceFiles:
    """Reads the folders and files that a listing is made from, and remembers their state."""

    def __init__(self) -> None:
        self.states: dict[str, list[int]] = {}

    def names(self, folder: Path, expected: str) -> list[str]:
        """Sorted names in `folder`; FileNotFoundError saying what was `expected` there."""
        self._note(folder)
        try:
            return sorted(path.name for path in folder.iterdir())
        except (FileNotFoundError, NotADirectoryError) as error:
            raise FileNotFoundError(f"{folder}: no such folder; expected {expected}") from error

    def text(self, path: Path, expected: str) -> str:
        """A text file's content; FileNotFoundError saying what was `expected`, ValueError for other bytes."""
        try:
            return self.content(path, expected).decode()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: not a text file ({error.reason}): fetch it again") from error

    def content(self, path: Path, expected: str) -> bytes:
        """A file's bytes; FileNotFoundError saying what was `expected`."""
        self._note(path)
        try:
            return path.read_bytes()
        except (FileNotFoundError, IsADirectoryError) as error:
            raise FileNotFoundError(f"{path}: no such file; expected {expected}") from error

    def exists(self, path: Path) -> bool:
        """Whether a file or folder is there now."""
        self._note(path)
        return path.exists()

    def _note(self, path: Path) -> None:
        self.states[str(path)] = _state(path)


class ListingIndex:
    """Listings of one data set in one folder, by key."""

    def __init__(self, kind: str, root: Path) -> None:
        """Args: `kind` tells readers apart, `root` is the data set's folder. Nothing is opened yet."""
        digest = hashlib.sha256(f"{FORMAT} {kind} {root.resolve()}".encode()).hexdigest()[:16]
        self.path = user_cache_folder("listings") / f"{kind}-{digest}.sqlite"

    def count(self, key: str) -> int | None:
        """The number kept with a listing, None where there is no current listing."""
        row = self._current("count", key)
        return None if row is None else int(row)

    def get(self, key: str) -> bytes | None:
        """A listing's bytes, None where there is no current one."""
        row = self._current("payload", key)
        return None if row is None else bytes(row)

    def put(self, key: str, payload: bytes, count: int, sources: SourceFiles) -> None:
        """Keeps a listing and the state of its sources, replacing an older one."""
        row = (key, count, json.dumps(sources.states), payload)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with closing(self._connect()) as connection, connection:
                connection.execute(_TABLE)
                connection.execute("INSERT OR REPLACE INTO listings VALUES (?, ?, ?, ?)", row)
        except (OSError, sqlite3.Error) as error:
            logging.log_first_n(logging.WARNING, "listings are not kept (%s: %s)", 1, self.path, error)

    def _current(self, column: str, key: str) -> int | bytes | None:
        if not self.path.is_file():
            return None
        try:
            with closing(self._connect()) as connection:
                row = connection.execute(f"SELECT {column}, sources FROM listings WHERE key = ?", (key,)).fetchone()
        except sqlite3.OperationalError:  # no table yet, or locked for longer than the timeout
            return None
        except sqlite3.DatabaseError as error:
            logging.warning("%s is damaged (%s) and made anew", self.path, error)
            self.path.unlink(missing_ok=True)
            return None
        if row is None or any(_state(Path(path)) != state for path, state in json.loads(row[1]).items()):
            return None
        return row[0]

    def _connect(self) -> sqlite3.Connection:
        # A connection a call: it can neither be pickled for worker processes nor survive a fork.
        return sqlite3.connect(self.path, timeout=_TIMEOUT)


def _state(path: Path) -> list[int]:
    """Time of change and size; a folder's time changes with the names in it."""
    try:
        status = path.stat()
    except OSError:
        return [_ABSENT, _ABSENT]
    return [status.st_mtime_ns, status.st_size if path.is_file() else 0]
