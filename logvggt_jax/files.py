"""Files that may be damaged, and results that appear whole or not at all: written under another name and renamed."""

import json
import os
import platform
import re
import secrets
import shutil
import stat
import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from filelock import FileLock, Timeout

from logvggt_jax.errors import DiskError, InputError, OutputExists, disk_errors, one_line

# NumPy parses an array's header with `ast`, which in Python 3.11 fails now and then where several threads do so.
_NUMPY_READING = threading.Lock()
EMPTY_PATH = "the path is empty (a variable without a value?)"
_LONGEST_NAME, _LONGEST_SUFFIX = 255, 32  # bytes
_LOCK, _OWNER = ".lock", ".owner"
# What file managers leave in any folder that somebody looks at.
_OF_FILE_MANAGERS = (".DS_Store", "._*", ".directory", "Thumbs.db", "desktop.ini")
# A name beside the one that a file is to have: see `_temporary_name`.
_TEMPORARY = re.compile(r"\..*\.\d+-[0-9a-f]{8}(\.[^.]*)?", re.DOTALL)


@contextmanager
def open_regular(path: str | Path) -> Iterator[BinaryIO]:
    """A regular file, open for reading bytes. What else has its name, a pipe above all, is refused and not waited for.

    Raises MissingInput where nothing is there, InputError where no file is, and DiskError where the operating system
    refuses to read it, also in the block.
    """
    with disk_errors(path):
        if not stat.S_ISREG(Path(path).stat().st_mode):
            raise InputError(f"{path} is no file but a folder, a pipe or a device")
        with Path(path).open("rb") as stream:
            yield stream


@contextmanager
def numpy_reading() -> Iterator[None]:
    """Around what reads NumPy's files, by one thread at a time. Raises ValueError, in one line, where they are damaged.

    NumPy and zipfile meet damage with two dozen kinds of errors, of Python's tokens among them. Errors of the operating
    system pass through unchanged.
    """
    with _NUMPY_READING:
        try:
            yield
        except OSError:
            raise
        except Exception as error:
            raise ValueError(one_line(error)) from error


def read_json(path: str | Path, mend: str) -> Any:
    """What a JSON file holds, which may begin with a byte order mark. Raises InputError ending in `mend` where it is no
    JSON, others as `open_regular`."""
    with open_regular(path) as stream:
        content = stream.read()
    try:
        return json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({one_line(error):.200}); {mend}") from error


def check_regular_files(folder: Path) -> None:
    """Raises InputError where anything in a folder, at any depth, is neither a file nor a folder, for libraries that
    open all of it themselves; DiskError as `disk_errors`."""
    with disk_errors(folder):
        for path in folder.rglob("*"):
            mode = path.stat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise InputError(f"{path} is neither a file nor a folder but a pipe or a device")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends, and vanishes if it fails.

    The name is this run's own and keeps the suffix of `path`, from which libraries take the format. Raises DiskError or
    MissingInput where the file cannot be written, whatever the operating system's reason.
    """
    path = Path(path)
    temporary = path.with_name(_temporary_name(path))
    with disk_errors(path):
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file as UTF-8, whole or not at all; errors as in `atomic_file`."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, "utf-8")


@contextmanager
def atomic_folder(path: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """A folder to fill, `<path>.<unique>.partial`, that becomes `path` when the block ends, and vanishes if it fails.

    Its parents are made too. With `replace` what is at `path` goes once the new folder stands in its place; callers
    make sure that it is worth no more than the new one (`check_output`). Raises OutputExists where something else than
    an empty folder is at `path` and `replace` is not set, or came to be there in the meantime; DiskError where the
    folder cannot be made or renamed.
    """
    path = Path(path)
    if not replace and not _is_free(path):
        raise _exists(path)
    partial = path.with_name(f"{path.name}.{_unique()}.partial")
    with disk_errors(partial):
        partial.mkdir(parents=True)
    try:
        yield partial
        with disk_errors(path):
            move_folder(partial, path, replace=replace)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def user_path(path: str | Path, *, resolved: bool = False) -> Path:
    """A path as somebody has written it, `~` expanded; absolute and without links where it is to be `resolved`.

    Raises InputError where it is empty, names the home of nobody, or goes through a link that leads to itself.
    """
    if not str(path).strip():
        raise InputError(EMPTY_PATH)
    try:
        found = Path(path).expanduser()
        return found.resolve() if resolved else found
    except RuntimeError as error:
        raise InputError(f"{path}: {one_line(error)}") from error


class FolderKind(NamedTuple):
    """What folders of one kind hold.

    Attributes:
      marker: a file that every finished one has, as a path in it.
      names: patterns of all that lies in one; what has another name is not of this program.
    """

    marker: str
    names: tuple[str, ...]


def check_output(output: str | Path, *, overwrite: bool, kind: FolderKind, in_place: bool = False) -> Path:
    """The absolute path of `output`, provided that a result may be written there; OutputExists otherwise.

    An empty folder that was made beforehand is as good as none. With `overwrite` an existing folder may be replaced
    that is of this `kind` and holds nothing else, so that a slip of the keyboard deletes no other folder, nor what
    somebody has put beside its content. Unless what is written goes `in_place`, into the folder itself, which then may
    hold what a lock left, a new folder takes its place at the end, which the top of a volume gives up for nobody.
    """
    output = user_path(output, resolved=True)
    with disk_errors(output):
        if output.is_mount() and not in_place:
            raise OutputExists(f"{output} is the top of a volume, which nothing can replace: choose a folder in it")
        if _is_free(output) or (in_place and holds_nothing(output)):
            return output
        if not overwrite:
            raise _exists(output)
        if not (output / kind.marker).is_file():
            raise OutputExists(
                f"{output} is not overwritten: it holds no {kind.marker}, so it is no earlier result; choose another "
                "output or delete it yourself"
            )
        foreign = foreign_entries(output, kind.names)
    if foreign:
        others = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        raise OutputExists(
            f"{output} is not overwritten: {foreign[0]}{others} in it is not of an earlier result, and would be "
            "deleted; move it elsewhere, or choose another output"
        )
    return output


def foreign_entries(folder: Path, names: Iterable[str]) -> list[str]:
    """What a folder holds beside the patterns `names`, in order; what lies deeper is not looked at."""
    known = (*names, *_OF_FILE_MANAGERS)
    return sorted(entry.name for entry in folder.iterdir() if not any(fnmatchcase(entry.name, name) for name in known))


def check_apart(output: Path, read: Iterable[str | Path]) -> None:
    """Raises InputError where something that is `read` lies in `output`, an absolute path, and would go with it when a
    new folder takes its place; through links, too."""
    if not output.is_dir():
        return
    folders: dict[Path, Path] = {}
    for path in map(Path, read):
        # Of many files in one folder each would be looked at from the top down.
        folder = folders.setdefault(path.parent, path.parent.resolve())
        found = path.resolve() if path.is_symlink() else folder / path.name
        if found == output or output in found.parents:
            raise InputError(f"output {output} contains {path}, which is read: choose another output")


def check_writable(output: Path) -> None:
    """Raises DiskError unless something can be made at `output`, an absolute path, as far as permissions tell."""
    parent = existing_parent(output)
    if not parent.is_dir():
        raise DiskError(f"{output}: {parent} is no folder; choose another output")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise DiskError(f"{output}: no permission to write in {parent}; choose another output")


def check_space(output: Path, needed: int, mend: str = "make room or choose another output") -> str:
    """How many bytes are needed at `output` and how many are free, in words; DiskError where they do not suffice."""
    parent = existing_parent(output)
    free = shutil.disk_usage(parent).free
    words = f"about {needed / 1e6:,.1f} MB, {free / 1e6:,.1f} MB are free in {parent}"
    if free < needed:
        raise DiskError(f"{output}: needs {words}; {mend}")
    return words


def existing_parent(path: Path) -> Path:
    """The innermost folder above `path` that is there."""
    return next(parent for parent in path.parents if parent.exists())


def holds_nothing(folder: Path) -> bool:
    """Whether a folder is empty, but for what the lock of a run leaves that ended before it wrote anything."""
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= {_LOCK, _OWNER}


class FolderLock:
    """The exclusive use of a folder, which ends with the process that has it, however that ends.

    Args:
      folder: made where it is not there; its `.lock` and `.owner` belong to the lock, see `holds_nothing`.
      mend: what else a user can do, for the end of an error.

    Raises:
      InputError: another run has the folder; says which process.
      DiskError: it cannot be written.
    """

    def __init__(self, folder: Path, mend: str) -> None:
        owner = folder / _OWNER
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(folder / _LOCK)
            try:
                self._lock.acquire(timeout=0)
            except Timeout:
                who = owner.read_text() if owner.exists() else "unknown"
                raise InputError(
                    f"{folder}: another run is using this folder ({who}); wait until it has ended or {mend}"
                ) from None
            except NotImplementedError as error:  # some network file systems
                warnings.warn(f"{folder} cannot be locked ({error}); take care that no other run uses it", stacklevel=2)
            try:
                owner.write_text(f"process {os.getpid()} on {platform.node()}")
            except OSError:
                self._lock.release()
                raise

    def release(self) -> None:
        """Lets others have the folder."""
        self._lock.release()


def to_disk(paths: Iterable[Path]) -> None:
    """Makes the operating system write files and folders: a full disk, or a lost one, says so here."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def user_cache_folder(kind: str) -> Path:
    """`logvggt/<kind>` in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`); not created here.

    Raises InputError for a user without a home.
    """
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    except RuntimeError as error:
        raise InputError(f"there is no home for what is kept between runs ({error}): set XDG_CACHE_HOME") from error
    return caches / "logvggt" / kind


def remove_temporary(folder: Path) -> None:
    """Removes what writers that were killed have left half-written in a folder that nobody else writes to."""
    for path in folder.rglob(".*"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file():
            path.unlink()


def _temporary_name(path: Path) -> str:
    """Of this run alone, with the beginning of the name and its suffix; no longer than file systems allow."""
    suffix = path.suffix if len(path.suffix) <= _LONGEST_SUFFIX else ""
    rest = f".{_unique()}{suffix}"
    room = _LONGEST_NAME - len(f".{rest}".encode())
    return f".{path.stem.encode(errors='ignore')[:room].decode(errors='ignore')}{rest}"


def _unique() -> str:
    return f"{os.getpid()}-{secrets.token_hex(4)}"


def _is_free(path: Path) -> bool:
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def _exists(path: Path) -> OutputExists:
    return OutputExists(f"{path} exists: choose another output or pass --overwrite to replace it")


def move_folder(source: Path, target: Path, *, replace: bool) -> None:
    """Renames a folder; with `replace` what is at `target` goes once the other stands in its place."""
    if not replace:
        if not _is_free(target):
            raise _exists(target)
        source.rename(target)  # an empty folder gives way
        return
    # A folder cannot replace a full one in one call: the old one steps aside and goes last.
    aside = target.with_name(f".{target.name}.{_unique()}.old")
    if target.exists():
        target.rename(aside)
    try:
        source.rename(target)
    except BaseException:  # Ctrl-C too
        if aside.exists():
            aside.rename(target)
        raise
    shutil.rmtree(aside, ignore_errors=True)
