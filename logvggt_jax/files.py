"""Results appear whole or not at all: files and folders written under another name and renamed at the end."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends, and vanishes if it fails."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_output(output: str | Path, *, overwrite: bool, marker: str) -> Path:
    """The absolute path of `output`, provided that `output_folder` may make or replace it.

    Raises:
      FileExistsError: it exists and may not be replaced.
    """
    output = Path(output).expanduser().resolve()
    if not output.exists():
        return output
    if not overwrite:
        raise FileExistsError(f"{output} exists: choose another output or pass --overwrite to replace it")
    if not output.is_dir() or (any(output.iterdir()) and not (output / marker).is_file()):
        raise FileExistsError(
            f"{output} is not overwritten: it holds no {marker}, so it is no earlier result; choose another "
            "output or delete it yourself"
        )
    return output


@contextmanager
def output_folder(output: str | Path, *, overwrite: bool, marker: str) -> Iterator[Path]:
    """A folder to fill that becomes `output` when the block ends, and vanishes if it fails.

    Args:
      output: the folder to make; its parents are made too.
      overwrite: replace an existing `output`, provided it is empty or holds `marker`, so that a slip of the
        keyboard deletes no other folder.
      marker: a file that every finished folder of this kind has.

    Yields:
      `<output>.partial`, which exists and is empty.

    Raises:
      FileExistsError: `output` or `<output>.partial` exists and may not be replaced.
    """
    output = check_output(output, overwrite=overwrite, marker=marker)
    partial = output.with_name(output.name + ".partial")
    if overwrite and partial.is_dir():
        shutil.rmtree(partial)
    partial.parent.mkdir(parents=True, exist_ok=True)
    try:
        partial.mkdir()
    except FileExistsError:
        raise FileExistsError(
            f"{partial} exists: another run is writing there, or one was killed; wait, or pass --overwrite to delete it"
        ) from None
    try:
        yield partial
        _replace_folder(partial, output)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _replace_folder(source: Path, target: Path) -> None:
    if not target.exists():
        source.rename(target)
        return
    # A folder cannot replace a full one in one call: the old one steps aside and goes last.
    aside = target.with_name(f".{target.name}.{os.getpid()}.old")
    target.rename(aside)
    try:
        source.rename(target)
    except OSError:
        aside.rename(target)
        raise
    shutil.rmtree(aside)


def user_cache_folder(kind: str) -> Path:
    """`logvggt/<kind>` in the user's cache folder (`XDG_CACHE_HOME`, else `~/.cache`); not created here."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "logvggt" / kind
