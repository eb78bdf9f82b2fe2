"""Paths as Orbax takes them."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

# Of patterns; of a backslash the library below Orbax makes a slash.
_MISREAD = frozenset("*?[\\")


@contextlib.contextmanager
def as_it_is_named(path: Path) -> Iterator[Path]:
    """A name of `path` that Orbax takes for this path and no other; the last part of it has to be an ordinary name.

    Orbax searches for what it has written by a pattern that begins with the path: in `runs/[3]` it finds nothing, and
    leaves without a word what nobody can read; in `runs/*` it may find another's. Through a link it gets there.
    """
    if _MISREAD.isdisjoint(str(path.parent)):
        yield path
        return
    with tempfile.TemporaryDirectory() as scratch:
        link = Path(scratch) / "parent"
        link.symlink_to(path.parent.absolute(), target_is_directory=True)
        yield link / path.name
