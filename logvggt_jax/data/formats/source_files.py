"""The folders and text files that a listing is made from, read with their state remembered."""

import codecs
import re
import stat
from collections.abc import Sequence
from pathlib import Path

from absl import logging

from logvggt_jax.data.errors import MissingFiles, missing_file
from logvggt_jax.errors import DiskError, InputError

_ABSENT = -1
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_PLACES, _PIECE = 16, 64  # bytes
# Not what file managers and network storage leave beside a set's folders, such as .thumbnails and @eaDir.
PLAIN_NAME = re.compile(r"[A-Za-z0-9][\w-]*")


class SourceFiles:
    """Reads the folders and files that a listing is made from, and remembers their state.

    Only regular files, and links to them, are opened: a pipe in the place of a file would be waited for without end.
    All methods raise InputError naming the path where its name cannot be one, and DiskError where the operating system
    refuses to look at it.

    Attributes:
      states: of what has been looked at, by path.
      remarks: what has been said, to be said again where the listing is taken from an index.
    """

    def __init__(self) -> None:
        self.states: dict[str, list[int]] = {}
        self.remarks: list[str] = []

    def remark(self, text: str) -> None:
        """Says what whoever uses the listing should know, one line."""
        self.remarks.append(text)
        logging.warning("%s", text)

    def names(self, folder: Path, expected: str) -> list[str]:
        """Sorted names in `folder`; MissingFiles saying what was `expected` there."""
        self._note(folder)
        try:
            return sorted(path.name for path in folder.iterdir())
        except (FileNotFoundError, NotADirectoryError) as error:
            raise MissingFiles(f"{folder}: no such folder; expected {expected}") from error
        except OSError as error:
            raise refused(folder, error) from error

    def folders(self, parent: Path, expected: str, named: re.Pattern[str] | None = None) -> dict[str, Path]:
        """Folders in `parent` by name, sorted, of those with a pattern the ones `named` so; MissingFiles as `names`."""
        chosen = [name for name in self.names(parent, expected) if named is None or named.fullmatch(name)]
        try:
            return {name: parent / name for name in chosen if (parent / name).is_dir()}
        except OSError as error:
            raise refused(parent, error) from error

    def folders_with(self, signs: Sequence[str], parent: Path, expected: str) -> dict[str, Path]:
        """Folders in `parent` by name, sorted, in which one of these names is there; MissingFiles as `names`."""
        folders = {name: parent / name for name in self.names(parent, expected)}
        return {name: each for name, each in folders.items() if any(self.exists(each / sign) for sign in signs)}

    def text(self, path: Path, expected: str) -> str:
        """A text file's content, without a byte order mark; MissingFiles saying what was `expected`, InputError for
        other bytes than UTF-8 or, behind its mark, UTF-16, in which Windows' shell redirects."""
        content = self.content(path, expected)
        try:
            return decoded(content)
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: not a text file ({error.reason}): fetch it again") from error

    def content(self, path: Path, expected: str) -> bytes:
        """A file's bytes; MissingFiles saying what was `expected`."""
        self._note(path)
        return read_regular(path, f"; expected {expected}")

    def regular(self, path: Path, expected: str) -> None:
        """For files that a library opens: MissingFiles saying what was `expected` unless there is a regular file."""
        self._note(path)
        check_regular(path, f"; expected {expected}")

    def exists(self, path: Path) -> bool:
        """Whether a file or folder is there now; warns of a folder at which the operating system refuses to look."""
        self._note(path)
        if self.states[str(path)] != [_ABSENT, _ABSENT]:
            return True
        try:
            path.stat()
        except PermissionError as error:
            self.remark(f"{path.parent}: {error.strerror}: nothing in it counts")
        except OSError:
            pass
        return False

    def _note(self, path: Path) -> None:
        self.states[str(path)] = file_state(path)


def decoded(content: bytes) -> str:
    """The text of a file, without a byte order mark: UTF-8 or, behind its mark, UTF-16. Raises UnicodeDecodeError."""
    return content.decode("utf-16" if content[:2] in _UTF_16 else "utf-8-sig")


def file_state(path: Path) -> list[int]:
    """Time of change and size; a folder's time changes with the names in it.

    Raises InputError naming what cannot be a path, as damaged lists may have it.
    """
    try:
        status = path.stat()
        return [status.st_mtime_ns, status.st_size if stat.S_ISREG(status.st_mode) else 0]
    except OSError:
        return [_ABSENT, _ABSENT]
    except ValueError as error:  # a zero byte, or half of a pair of UTF-16 codes
        raise InputError(f"{str(path)!r} cannot be the name of a file ({error}): fetch what names it again") from error


def file_glimpse(path: Path) -> bytes:
    """A kilobyte of a file, from places all over it: of one whose size says nothing of what it holds. Empty where it
    cannot be read, or is no regular file."""
    size = file_state(path)[1]
    if size <= 0:
        return b""
    try:
        with path.open("rb") as file:
            pieces = []
            for place in range(_PLACES):
                file.seek(place * size // _PLACES)
                pieces.append(file.read(_PIECE))
    except OSError:
        return b""
    return b"".join(pieces)


def check_regular(path: str | Path, reason: str | None = None) -> None:
    """Raises MissingFiles, with `reason` at its end, unless `path` is a regular file or a link to one.

    DiskError where the operating system refuses to say.
    """
    try:
        is_regular = stat.S_ISREG(Path(path).stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        is_regular = False
    except OSError as error:
        raise refused(path, error) from error
    if not is_regular:
        raise missing_file(path) if reason is None else missing_file(path, reason)


def read_regular(path: str | Path, reason: str | None = None) -> bytes:
    """Bytes of a file; errors as in `check_regular`."""
    check_regular(path, reason)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise refused(path, error) from error


def refused(path: str | Path, error: OSError) -> DiskError:
    """The error for a file or folder at which the operating system refuses to look."""
    return DiskError(f"{path}: {error.strerror or error}: make it readable or fetch it again")
