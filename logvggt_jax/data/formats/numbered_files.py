"""Files whose names carry a frame's number: listed in numeric order, with the gaps between kinds reported."""

import re
from collections.abc import Mapping
from pathlib import Path

from logvggt_jax.data.errors import MissingFiles, missing_files
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.errors import InputError

_PLACE = re.compile(r"\{[^}]*\}")


def numbered_files(files: SourceFiles, folder: Path, template: str) -> dict[int, Path]:
    """Files of `folder` by number, in numeric order.

    `template` is the format of the names with one number: `frame{:06d}.jpg`, or `{}.jpg` for numbers that may be padded
    with zeros or not, as exporters differ; all other names are passed over. Raises MissingFiles where there is no such
    folder, or no such file in it, and InputError for two files of one number.
    """
    before, after = _PLACE.split(template)
    pattern = re.compile(f"{re.escape(before)}([0-9]+){re.escape(after)}")
    found: dict[int, Path] = {}
    for name in files.names(folder, f"files like {template.format(0)}"):
        match = pattern.fullmatch(name)
        if match is None or ("{}" not in template and template.format(int(match[1])) != name):
            continue
        path = found.setdefault(int(match[1]), folder / name)
        if path.name != name:
            raise InputError(f"{folder / name} and {path.name} have the same number: remove one of them")
    if not found:
        raise MissingFiles(f"{folder}: no files like {template.format(0)}; fetch or unpack the sequence again")
    return dict(sorted(found.items()))


def numbered_frames(files: SourceFiles, *kinds: tuple[Path, str]) -> dict[int, tuple[Path, ...]]:
    """Frames that consist of one file of each kind (folder and template): number to paths, in numeric order.

    Raises MissingFiles as `numbered_files`, and for frames that lack a kind; names the missing files.
    """
    found = [numbered_files(files, folder, template) for folder, template in kinds]
    numbers = sorted(set().union(*found))
    absent = {
        folder / template.format(number): f"but frame {number} has its other files; fetch it again or remove those"
        for number in numbers
        for (folder, template), paths in zip(kinds, found, strict=True)
        if number not in paths
    }
    if absent:
        raise missing_files(absent)
    return {number: tuple(paths[number] for paths in found) for number in numbers}


def without_gaps(frames: Mapping[int, tuple[Path, ...]]) -> list[tuple[Path, ...]]:
    """The paths of `numbered_frames`, where frame follows frame as in a pose file that has no numbers.

    Raises MissingFiles naming the first missing frame.
    """
    first = next(iter(frames))
    for number in range(first, first + len(frames)):
        if number not in frames:
            folder = frames[first][0].parent
            raise MissingFiles(f"{folder}: frame {number} is missing among the others: fetch the sequence again")
    return list(frames.values())
