"""Which pictures a folder, a glob or a list of files names, and what is left out."""

from __future__ import annotations

import dataclasses
import errno
import glob
import os
import re
import stat
from collections import Counter, defaultdict
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from logvggt_jax.data.formats.ordering import missing_numbers
from logvggt_jax.data.formats.source_files import decoded
from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.reconstruction.sources.pictures import IMAGE_SUFFIXES

LIST_SUFFIXES = (".txt", ".lst", ".list")
SEVEN_SCENES_COLOUR = (".color.png", ".color.jpg")
_SEVEN_SCENES = re.compile(
    r"(?P<name>.+)\.(?P<part>color(?=\.(?:png|jpg)$)|depth(?=(?:\.\w+)?\.png$)|pose(?=\.txt$))\..+", re.IGNORECASE
)
_NO_COLOURS = re.compile(
    r"mask|depth|thumb"
    r"|(?:^|[^a-z])(?:seg|segmentation|semantic|labels?|disp|disparity|normals?|matte|alpha|albedo|flow|conf|confidence)"
    r"(?:[^a-z]|$)"
)


@dataclasses.dataclass(frozen=True)
class Listing:
    """Files that are pictures by their names.

    Attributes:
      files: the files, in the order of a list of files, else by name.
      root: the folder that all lie in.
      in_order: whether the order is the user's own.
      left_out: what is left out or missing, one line a kind.
      doubts: what may be taken by mistake, one line a kind.
    """

    files: list[Path]
    root: Path
    in_order: bool
    left_out: list[str]
    doubts: list[str]


def names_pictures(path: Path) -> bool:
    """Whether a path is a folder, a list of files, or a glob that is not itself the name of a file."""
    with disk_errors(path):
        if path.exists():
            return path.is_dir() or (path.is_file() and path.suffix.lower() in LIST_SUFFIXES)
        return is_glob(path)


def is_glob(path: Path) -> bool:
    """Whether a path has the characters of a glob."""
    return glob.has_magic(str(path))


def list_pictures(path: Path, pattern: str | None) -> Listing:
    """The pictures of a folder, of a glob (`photos/*.jpg`), or of a text file with a path a line.

    A list's paths are relative to its own folder; blank lines and those that begin with # say nothing. Its files are
    pictures whatever their names; elsewhere the suffix decides. `pattern` is a glob for the names.

    Raises:
      MissingInput: no picture, or one of a list's is not there.
      InputError: a list that is no text.
    """
    with disk_errors(path):
        if path.is_dir():
            return _of_folder(path, pattern)
        return _of_list(path, pattern) if path.is_file() else _of_glob(path, pattern)


def stem(name: str) -> str:
    """A picture's name without what tells its format."""
    lower = name.lower()
    for suffix in (*SEVEN_SCENES_COLOUR, *IMAGE_SUFFIXES):
        if lower.endswith(suffix) and len(lower) > len(suffix):
            return name[: -len(suffix)]
    return name


def some(names: Iterable[str]) -> str:
    """The first three of some names."""
    names = list(names)
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


def _of_folder(folder: Path, pattern: str | None) -> Listing:
    entries = sorted(folder.iterdir())
    files, left_out = _pictures([entry for entry in entries if _matches(entry, pattern)], told=pattern is None)
    if not files:
        expected = "expected a picture" if pattern is None else f"none matches --pattern {pattern!r}: expected one"
        raise MissingInput(
            f"no image in {folder}: {expected} ({', '.join(IMAGE_SUFFIXES)}), found {_contents(entries)}; give the "
            "folder that holds the images themselves, or the file of a video, or convert them"
        )
    folders = _folders_with_pictures(entries)
    if folders and pattern is None:
        left_out.append(f"sub-folders are not searched; with images there are {folders}")
    return Listing(files, folder, False, left_out, _doubts(files))


def _of_glob(path: Path, pattern: str | None) -> Listing:
    root = path.parent
    while is_glob(root) and not root.exists():  # names of folders may have brackets
        root = root.parent
    entries = sorted(root.glob(str(path.relative_to(root))))
    files, left_out = _pictures([entry for entry in entries if _matches(entry, pattern)], told=True)
    if not files:
        found = f"found {_contents(entries)}" if entries else "nothing has such a name"
        both = "" if pattern is None else f" and --pattern {pattern!r}"
        raise MissingInput(f"no image matches {path}{both}: {found}; does the folder {root} hold them?")
    return Listing(files, root, False, left_out, _doubts(files))


def _of_list(path: Path, pattern: str | None) -> Listing:
    try:
        lines = decoded(path.read_bytes()).splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no text in UTF-8 or UTF-16: expected a list of images, one path a line") from error
    files: dict[Path, int] = {}
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        file = path.absolute().parent / text
        with disk_errors(f"{path}, line {number}"):
            if "\\" in text and not file.exists():  # as Windows has them between folders
                file = path.absolute().parent / text.replace("\\", "/")
            if "\0" in text or not file.exists():
                raise MissingInput(
                    f"{path} is text and taken for a list of images; line {number} names no file: {text!r}; paths are "
                    f"relative to {path.parent}"
                )
            if not file.is_file():
                raise InputError(f"{path}, line {number}: {text!r} is no file: expected an image a line")
        if file in files:
            raise InputError(f"{path}, line {number}: {text!r} is in line {files[file]} already: name each image once")
        if _matches(file, pattern):
            files[file] = number
    if not files:
        raise MissingInput(f"no image in {path}: expected a list of image files, one path a line")
    root = Path(os.path.commonpath([str(file.parent) for file in files]))
    return Listing(list(files), root, True, [], [])


def _matches(entry: Path, pattern: str | None) -> bool:
    return pattern is None or fnmatchcase(entry.name, pattern)


def _pictures(entries: list[Path], *, told: bool) -> tuple[list[Path], list[str]]:
    """The files among these that are pictures by their names, and lines on the others.

    Those that are no pictures by their names are told where the user did not choose by a pattern. Depth maps, poses and
    lists of a 7-Scenes sequence are no news.
    """
    companions, orphans = _of_seven_scenes(entries)
    files, others = list[Path](), list[Path]()
    left: dict[str, list[Path]] = defaultdict(list)
    for entry in entries:
        kind = _kind(entry)
        named = entry.suffix.lower() in IMAGE_SUFFIXES
        if kind == "file" and entry in companions:
            continue
        if named and entry.name.startswith("."):
            left["hidden file"].append(entry)
        elif named and kind != "file":
            left[kind].append(entry)
        elif named and entry not in orphans:
            files.append(entry)
        elif kind == "file" and not named and not entry.name.startswith("."):
            others.append(entry)
    if companions:
        others = [entry for entry in others if entry.suffix.lower() != ".txt"]
    lines = [
        f"left out: {len(those)} {kind}{'s' if len(those) > 1 else ''} with an image's name "
        f"({some(each.name for each in those)})"
        for kind, those in left.items()
    ]
    if others and told:
        lines.append(f"left out: {len(others)} without an image's suffix ({_suffixes(others)})")
    if orphans:
        lines.append(
            f"left out: {len(orphans)} depth maps without their colour image "
            f"({some(sorted(orphan.name for orphan in orphans))})"
        )
    gaps = missing_numbers([stem(entry.name) for entry in entries if entry.suffix.lower() in IMAGE_SUFFIXES])
    return files, lines + gaps


def _of_seven_scenes(entries: list[Path]) -> tuple[set[Path], set[Path]]:
    """What belongs to a `NAME.color.png` of the same name, and depth maps that ought to and whose colour is missing."""
    frames: dict[tuple[Path, str], dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for entry in entries:
        if found := _SEVEN_SCENES.fullmatch(entry.name):
            frames[entry.parent, found["name"].lower()][found["part"].lower()].append(entry)
    companions, orphans = set[Path](), set[Path]()
    for parts in frames.values():
        if "color" in parts:
            companions.update(parts["depth"], parts["pose"])
        else:
            orphans.update(parts["depth"])
    return companions, orphans if companions else set()


def _kind(entry: Path) -> str:
    """`file`, or what stands in its place."""
    try:
        mode = entry.stat().st_mode
    except OSError as error:
        kinds = {errno.ENOENT: "broken link", errno.ELOOP: "looping link"}
        return kinds.get(error.errno or 0, f"unreadable entry ({error.strerror})")
    kinds = {stat.S_IFREG: "file", stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket"}
    return kinds.get(stat.S_IFMT(mode), "device")


def _doubts(files: list[Path]) -> list[str]:
    """Lines on names that are taken as frames, and look like something else."""
    notes = []
    suspects, rest = list[Path](), list[Path]()
    for file in files:
        (suspects if _NO_COLOURS.search(stem(file.name).lower()) else rest).append(file)
    if suspects and rest:
        suffixes = {file.suffix for file in rest}
        apart = len(suffixes) == 1 and not suffixes & {file.suffix for file in suspects}
        example = f", for example --pattern '*{rest[0].suffix}'" if apart else ""
        notes.append(
            f"{len(suspects)} of {len(files)} names look like masks, depth maps or thumbnails "
            f"({some(each.name for each in suspects)}) and are taken as frames: choose with --pattern{example}"
        )
    same = Counter((file.parent, stem(file.name)) for file in rest)
    if twice := [file.name for file in rest if same[file.parent, stem(file.name)] > 1]:
        notes.append(
            f"{len(twice)} images have the name of another but for the suffix ({some(twice)}); each is taken as a "
            "frame: choose with --pattern"
        )
    return notes


def _contents(entries: list[Path]) -> str:
    """What a folder without pictures holds."""
    kinds: dict[str, list[Path]] = defaultdict(list)
    for entry in entries:
        kinds[_kind(entry)].append(entry)
    found = [_suffixes(kinds.pop("file", []))]
    subfolders = kinds.pop("folder", [])
    found += [
        f"{len(those)} {kind}{'s' if len(those) > 1 else ''} ({some(each.name for each in those)})"
        for kind, those in kinds.items()
    ]
    if folders := _folders_with_pictures(entries):
        found.append(f"sub-folders with images: {folders}")
    elif subfolders:
        found.append("sub-folders without images")
    return "; ".join(part for part in found if part) or "nothing"


def _suffixes(files: list[Path]) -> str:
    counts = Counter(
        ("hidden " if file.name.startswith(".") else "") + (file.suffix or "without suffix") for file in files
    )
    return ", ".join(f"{count} {suffix}" for suffix, count in counts.most_common(6)) + (
        ", …" if len(counts) > 6 else ""
    )


def _folders_with_pictures(entries: list[Path]) -> str:
    """Sub-folders and how many images each holds, as one text; empty where there are none."""
    counts = {}
    for entry in entries:
        if _kind(entry) == "folder" and not entry.name.startswith("."):
            try:
                inside = list(entry.iterdir())
            except OSError:
                continue  # nothing of it is asked for
            counts[entry.name] = sum(each.suffix.lower() in IMAGE_SUFFIXES for each in inside)
    return some(f"{name}/ ({count})" for name, count in counts.items() if count)
