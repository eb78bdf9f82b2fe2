"""Damage as files of people's copies have it: each function spoils one file in a seeded way, the same for every run."""

import gzip
import os
import re
import stat
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]
_STRING = re.compile(rb':\s*("[^"]*")')
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


def bit_flipped(content: bytes, random: np.random.Generator) -> bytes:
    """One bit is another."""
    damaged = bytearray(content)
    damaged[random.integers(len(content))] ^= 1 << int(random.integers(8))
    return bytes(damaged)


def cut_in_half(content: bytes, random: np.random.Generator) -> bytes:
    """The rest of the file never arrived."""
    return content[: len(content) // 2]


def lines_swapped(content: bytes, random: np.random.Generator) -> bytes:
    """Two lines have changed places."""
    lines = content.split(b"\n")
    first, second = random.integers(len(lines), size=2)
    lines[first], lines[second] = lines[second], lines[first]
    return b"\n".join(lines)


def not_utf_8(content: bytes, random: np.random.Generator) -> bytes:
    """Bytes in the middle that are no text."""
    middle = len(content) // 2
    return content[:middle] + b"\xff\xfe\x00" + content[middle:]


def emptied(content: bytes, random: np.random.Generator) -> bytes:
    """Nothing is left."""
    return b""


def number_replaced(by: bytes) -> Damage:
    """One of the text's numbers is another text."""

    def replaced(content: bytes, random: np.random.Generator) -> bytes:
        places = list(_NUMBER.finditer(content))
        if not places:
            return content + by
        place = places[random.integers(len(places))]
        return content[: place.start()] + by + content[place.end() :]

    return replaced


def double_replaced(by: float) -> Damage:
    """One of the numbers in a binary file is another."""

    def replaced(content: bytes, random: np.random.Generator) -> bytes:
        place = 4 * int(random.integers(max(1, len(content) // 4)))
        return content[:place] + np.array(by, "<f8").tobytes() + content[place + 8 :]

    return replaced


def string_replaced(content: bytes, random: np.random.Generator) -> bytes:
    """A number stands where JSON had text."""
    places = list(_STRING.finditer(content))
    if not places:
        return content
    place = places[random.integers(len(places))]
    return content[: place.start(1)] + b"5" + content[place.end(1) :]


def unpacked(change: Damage) -> Damage:
    """The damage to what a gzip file holds; to its bytes where it was damaged before."""

    def spoiled(content: bytes, random: np.random.Generator) -> bytes:
        try:
            inside = gzip.decompress(content)
        except (OSError, EOFError, zlib.error):
            return change(content, random)
        return gzip.compress(change(inside, random))

    return spoiled


CONTENT_DAMAGES: dict[str, Damage] = {
    "bit": bit_flipped,
    "cut": cut_in_half,
    "lines": lines_swapped,
    "bytes": not_utf_8,
    "empty": emptied,
    "string": string_replaced,
    **{f"number {text}": number_replaced(text.encode()) for text in ("nan", "inf", "1e39", "1e300", "-1", '"x"', "0")},
    # As JSON writes it.
    "number Infinity": number_replaced(b"Infinity"),
    **{f"double {number}": double_replaced(number) for number in (np.nan, np.inf, 1e39, 1e300)},
}
"""What happens to a file's content, by name."""


def as_pipe(path: Path) -> None:
    """A pipe that nobody writes to: opening it would wait for ever."""
    path.unlink()
    os.mkfifo(path)


def as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def as_looping_link(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def unreadable(path: Path) -> None:
    """No permission to read; nothing to the superuser."""
    path.chmod(0)


PLACE_DAMAGES: dict[str, Callable[[Path], None]] = {
    "pipe": as_pipe,
    "folder": as_folder,
    "looping link": as_looping_link,
    "no permission": unreadable,
}
"""What stands in a file's place, by name."""


def damaged_copies(root: Path, files: Iterable[Path], damages: Collection[str], *, seed: int) -> Iterator[str]:
    """Spoils each of `files` below `root` in each of the named ways, one at a time; mends it after the next step.

    Yields what was done. What `CONTENT_DAMAGES` do is also done to what a gzip file holds.
    """
    random = np.random.default_rng(seed)
    for path in files:
        whole, mode = path.read_bytes(), stat.S_IMODE(path.stat().st_mode)
        place = path.relative_to(root)
        for name in damages:
            if name in PLACE_DAMAGES:
                PLACE_DAMAGES[name](path)
                yield f"{place}: {name}"
                _removed(path)
            else:
                path.write_bytes(CONTENT_DAMAGES[name](whole, random))
                yield f"{place}: {name}"
                if path.suffix == ".jgz":
                    path.write_bytes(unpacked(CONTENT_DAMAGES[name])(whole, random))
                    yield f"{place}: {name} within"
            path.write_bytes(whole)
            path.chmod(mode)


def _removed(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink()
