"""Results appear whole or not at all: files and folders written under another name and renamed at the end."""

import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from logvggt_jax.errors import InputError, OutputExists, disk_errors


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
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends, and vanishes if it fails.

    The name is this run's own and keeps the suffix of `path`, from which libraries take the format. Raises DiskError or
    MissingInput where the file cannot be written, whatever the operating system's reason.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{_unique()}{path.suffix}")
    with disk_errors(path):
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file whole or not at all; errors as in `atomic_file`."""
    with atomic_file(path) as temporary:
        temporary.write_text(text)


@contextmanager
def atomic_folder(path: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """A folder to fill, `<path>.<unique>.partial`, that becomes `path` when the block ends, and vanishes if it fails.

    Its parents are made too. With `replace` what is at `path` goes once the new folder stands in its place; callers
    make sure that it is worth no more than the new one (`check_output`). Raises OutputExists where something is at
    `path` and `replace` is not set, or came to be there in the meantime; DiskError where the folder cannot be made or
    renamed.
    """
    path = Path(path)
    if not replace and path.exists():
        raise _exists(path)
    partial = path.with_name(f"{path.name}.{_unique()}.partial")
    with disk_errors(partial):
        partial.mkdir(parents=True)
    try:
        yield partial
        with disk_errors(path):
            _move(partial, path, replace=replace)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def check_output(output: str | Path, *, overwrite: bool, marker: str) -> Path:
    """The absolute path of `output`, provided that a result may be written there; OutputExists otherwise.

    With `overwrite` an existing folder may be replaced, provided it is empty or holds `marker`, a file that every
    finished folder of this kind has, so that a slip of the keyboard deletes no other folder.
    """
    try:
        output = Path(output).expanduser().resolve()
    except RuntimeError as error:  # a link that leads to itself, the home of nobody
        raise InputError(f"{output}: {error}") from error
    with disk_errors(output):
        if not output.exists():
            return output
        if not overwrite:
            raise _exists(output)
        replaceable = output.is_dir() and (not any(output.iterdir()) or (output / marker).is_file())
    if not replaceable:
        raise OutputExists(
            f"{output} is not overwritten: it holds no {marker}, so it is no earlier result; choose another "
            "output or delete it yourself"
        )
    return output


def user_cache_folder(kind: str) -> Path:
    """`logvggt/<kind>` in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`); not created here."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "logvggt" / kind


def _unique() -> str:
    return f"{os.getpid()}-{secrets.token_hex(4)}"


def _exists(path: Path) -> OutputExists:
    return OutputExists(f"{path} exists: choose another output or pass --overwrite to replace it")


def _move(source: Path, target: Path, *, replace: bool) -> None:
    if not replace:
        if target.exists():
            raise _exists(target)
        source.rename(target)
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
