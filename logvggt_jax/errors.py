"""Errors of what a user gave, which entry points shorten to one line; any other exception keeps its traceback."""

import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Control characters, lone surrogates (bytes of a name that are not UTF-8), separators of lines, and what reorders text;
# joiners are letters' own.
_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
_JOINERS = "\u200c\u200d"


class InputError(ValueError):
    """What a user gave cannot be used: a file, a folder, a setting, an option.

    The message is one line that says what is wrong, where, and how to mend it. Entry points print it (`one_line`)
    and exit; any other exception is a fault of this package and keeps its traceback.
    """


class MissingInput(InputError, FileNotFoundError):
    """A file or folder that a user named, or that has to lie in a folder that a user named, is not there."""


class OutputExists(InputError, FileExistsError):
    """A result would have to replace something that a user may want to keep."""


class MissingPackage(InputError, ImportError):
    """What a user asked for needs an optional library that is not installed; the message names the extra."""


class DiskError(InputError, OSError):
    """The operating system refuses to read or write a user's file: no permission, a full disk, a lost network."""


@contextmanager
def disk_errors(path: str | Path) -> Iterator[None]:
    """Turns the operating system's errors in the block, which reads or writes `path`, into one line that names it.

    MissingInput where the file is not there, DiskError for any other OSError; an InputError passes through unchanged.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        kind = MissingInput if isinstance(error, FileNotFoundError) else DiskError
        raise kind(f"{path}: {error.strerror or error}") from error


def too_little_memory(path: str | Path, size: tuple[int, int] | None, error: MemoryError) -> InputError:
    """The error of a file whose pictures, of this size (H, W) where it is known, do not fit the memory of the host."""
    of_size = "" if size is None else f" of {size[1]} x {size[0]} pixels"
    return InputError(
        f"{path}: too little memory for a picture{of_size} ({one_line(error)}); close other programs, or give smaller "
        "pictures"
    )


def printable(text: str) -> str:
    """A user's text with control characters shown as escapes, so that it stays on its line and moves no cursor.

    Names of files, sequences and titles come from anywhere; a terminal would obey what they hold, and a stream in
    UTF-8 refuses a name that is not.
    """
    if text.isprintable():
        return text
    return "".join(_escaped(c) if unicodedata.category(c) in _UNSEEN and c not in _JOINERS else c for c in text)


def one_line(error: BaseException) -> str:
    """An error's message on one line, `printable`."""
    return printable(" ".join(str(error).split())) or type(error).__name__


def _escaped(character: str) -> str:
    # A byte that is not UTF-8 stands in a name as a surrogate, and is shown as the byte.
    if "\udc80" <= character <= "\udcff":
        return f"\\x{ord(character) - 0xDC00:02x}"
    return character.encode("unicode_escape", "surrogatepass").decode()


def install_line(extra: str) -> str:
    """The command that brings an extra of this package, for messages."""
    return f'pip install "logvggt-jax[{extra}]"'
