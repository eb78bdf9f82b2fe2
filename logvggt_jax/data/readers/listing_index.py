"""Listings of data sets kept on disk: the second start does not walk a million files again.

A listing remembers the code that made it, the state of every folder and file that it was made from, and what was
remarked of them. While code and state are unchanged it is taken from the index, and what was remarked is said again,
else it is made anew; an open data set asks once for each listing, not at each read. The index is a cache: where it
cannot be written, data sets work without it.
"""

import hashlib
import json
import sqlite3
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from absl import logging

from logvggt_jax.data.formats.source_files import SourceFiles, file_state
from logvggt_jax.files import user_cache_folder

_FORMAT = 4  # of the table
_TIMEOUT = 30.0  # seconds to wait for another process that writes
_TABLE = (
    "CREATE TABLE IF NOT EXISTS listings "
    "(key TEXT PRIMARY KEY, code TEXT, count INTEGER, sources TEXT, remarks TEXT, payload BLOB)"
)
_PACKAGE = __name__.partition(".")[0]


class ListingIndex:
    """Listings of one data set in one folder, by key."""

    def __init__(self, identity: Mapping[str, Any], root: Path, code: str) -> None:
        """Nothing is opened yet.

        `identity` has JSON values that tell readers and their options apart, `name` among them; `root` is the set's
        folder; `code` is the digest of the code that makes the listings: those of other code are not current.
        """
        what = json.dumps([_FORMAT, identity, str(root.resolve())], sort_keys=True)
        digest = hashlib.sha256(what.encode()).hexdigest()[:16]
        self.path = user_cache_folder("listings") / f"{identity['name']}-{digest}.sqlite"
        self._code = code
        self._checked: set[str] = set()  # keys of listings whose sources were looked at

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
        row = (_as_text(key), self._code, count, json.dumps(sources.states), json.dumps(sources.remarks), payload)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with closing(self._connect()) as connection, connection:
                connection.execute(_TABLE)
                connection.execute("INSERT OR REPLACE INTO listings VALUES (?, ?, ?, ?, ?, ?)", row)
            self._checked.add(key)
        except (OSError, sqlite3.Error) as error:
            logging.log_first_n(logging.WARNING, "listings are not kept (%s: %s)", 1, self.path, error)

    def _current(self, column: str, key: str) -> int | bytes | None:
        if not self.path.is_file():
            return None
        query = f"SELECT {column}, sources, remarks FROM listings WHERE key = ? AND code = ?"
        try:
            with closing(self._connect()) as connection:
                row = connection.execute(query, (_as_text(key), self._code)).fetchone()
        except sqlite3.OperationalError:  # no table yet, or locked for longer than the timeout
            return None
        except sqlite3.DatabaseError as error:
            logging.warning("%s is damaged (%s) and made anew", self.path, error)
            self.path.unlink(missing_ok=True)
            return None
        if row is None:
            return None
        if key not in self._checked:
            if any(file_state(Path(path)) != state for path, state in json.loads(row[1]).items()):
                return None
            self._checked.add(key)
            for remark in json.loads(row[2]):
                logging.warning("%s", remark)
        return row[0]

    def _connect(self) -> sqlite3.Connection:
        # A connection a call: it can neither be pickled for worker processes nor survive a fork.
        return sqlite3.connect(self.path, timeout=_TIMEOUT)


def _as_text(key: str) -> str:
    """A key that SQLite takes: names of folders need not be UTF-8."""
    return key.encode(errors="backslashreplace").decode()


def code_digest(reader: type) -> str:
    """Digest of the source of a reader's modules, and of all modules of this package that they use."""
    pending = {base.__module__ for base in reader.__mro__} - sys.stdlib_module_names
    sources: dict[str, bytes] = {}
    while pending:
        module = sys.modules[pending.pop()]
        assert module.__file__ is not None
        sources[module.__name__] = Path(module.__file__).read_bytes()
        used = {getattr(value, "__module__", None) or "" for value in vars(module).values()}
        pending |= {name for name in used if name.partition(".")[0] == _PACKAGE} - sources.keys()
    digest = hashlib.sha256()
    for _, source in sorted(sources.items()):
        digest.update(source)
    return digest.hexdigest()[:16]
