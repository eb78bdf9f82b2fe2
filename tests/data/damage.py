"""Damage as files of people's copies have it: each function spoils one file in a seeded way, the same for every run."""

import os
import re
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

TEXT_SUFFIXES = frozenset({"", ".txt", ".json", ".csv", ".traj", ".pincam", ".cam", ".npz", ".jgz", ".bin"})
"""Of calibrations, poses and lists; `metadata` of WildRGB-D has none."""

Damage = Callable[[bytes, np.random.Generator], bytes]
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


CONTENT_DAMAGES: dict[str, Damage] = {
    "bit": bit_flipped,
    "cut": cut_in_half,
    "lines": lines_swapped,
    "bytes": not_utf_8,
    "empty": emptied,
    **{f"number {text}": number_replaced(text.encode()) for text in ("nan", "inf", "1e39", "1e300", "-1", '"x"', "0")},
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


def text_files(root: Path) -> list[Path]:
    """Calibrations, poses and lists below `root`, in a fixed order."""
    return sorted(path for path in root.rglob("*") if path.is_file() and path.suffix in TEXT_SUFFIXES)


def damaged_copies(root: Path, files: list[Path], seed: int) -> Iterator[str]:
    """Spoils each of `files` below `root` in every way, one at a time, and yields what was done; mends it afterwards."""
    random = np.random.default_rng(seed)
    for path in files:
        whole, mode = path.read_bytes(), stat.S_IMODE(path.stat().st_mode)
        for name, change in CONTENT_DAMAGES.items():
            path.write_bytes(change(whole, random))
            yield f"{path.relative_to(root)}: {name}"
        path.write_bytes(whole)
        for name, put in PLACE_DAMAGES.items():
            put(path)
            yield f"{path.relative_to(root)}: {name}"
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            else:
                path.unlink()
            path.write_bytes(whole)
            path.chmod(mode)
