"""What happens to one file of an input: chosen by chance, the same for the same seed.

Single faults of content and place are those of `tests/data/damage.py`; here are those that need other files, the format
of the file, or the folder around it.
"""

from __future__ import annotations

import functools
import io
import os
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from damage import CONTENT_DAMAGES, PLACE_DAMAGES, Damage, unpacked
from PIL import Image

_SECOND = 0.15  # share of the cases that meet two damages
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_ARCHIVES = (".npz", ".pt", ".pth", ".zip")
_PACKED = (".gz", ".jgz")


def damage(root: Path, random: np.random.Generator) -> str:
    """Spoils one or two files below `root`; returns what was done."""
    done = [_one_damage(root, random)]
    if random.random() < _SECOND:
        done.append(_one_damage(root, random))
    return "; ".join(done)


def _one_damage(root: Path, random: np.random.Generator) -> str:
    # Names may be left to chance by whoever wrote the files, sizes are not.
    files = sorted((path.stat().st_size, str(path)) for path in root.rglob("*") if path.is_file())
    if not files:
        return "nothing is left to damage"
    path = Path(files[random.integers(len(files))][1])
    place = path.relative_to(root)
    if random.random() < 0.2:
        name, change_place = _pick(_places(), random)
        change_place(path)
        return f"{place}: {name}"
    name, change = _pick(_contents(path, [Path(name) for _, name in files]), random)
    _write(path, change(_read(path), random))
    return f"{place}: {name}"


def _read(path: Path) -> bytes:
    """What is in a file, also in one that was made unreadable before."""
    mode = path.stat().st_mode
    path.chmod(0o600)
    content = path.read_bytes()
    path.chmod(mode)
    return content


def _write(path: Path, content: bytes) -> None:
    mode = path.stat().st_mode
    path.chmod(0o600)
    path.write_bytes(content)
    path.chmod(mode)


def _pick(choices: dict, random: np.random.Generator) -> tuple:
    return list(choices.items())[random.integers(len(choices))]


def _places() -> dict[str, Callable[[Path], object]]:
    places: dict[str, Callable[[Path], object]] = {**PLACE_DAMAGES, "removed": Path.unlink}
    places |= {"link to nothing": _as_dangling_link, "folder removed": _folder_removed}
    places |= {"renamed": _renamed, "copied beside": _copied}
    if _nothing_is_forbidden():
        del places["no permission"]
    else:
        places["folder without permission"] = lambda path: path.parent.chmod(0)
    return places


@functools.cache
def _nothing_is_forbidden() -> bool:
    """As to the superuser, outside of some containers."""
    with tempfile.NamedTemporaryFile() as file:
        Path(file.name).chmod(0)
        return os.access(file.name, os.R_OK)


def _contents(path: Path, files: list[Path]) -> dict[str, Damage]:
    damages: dict[str, Damage] = {**CONTENT_DAMAGES, **_BYTES}

    def another(content: bytes, random: np.random.Generator) -> bytes:
        return _read(files[random.integers(len(files))])

    damages["content of another file"] = another
    suffix = path.suffix.lower()
    if suffix in _PICTURES:
        for name, size in (("wider", (2, 1)), ("smaller", (0.5, 0.5)), ("one pixel", (0, 0)), ("turned", None)):
            damages[f"picture {name}"] = _resized(suffix, size)
    if suffix == ".npz":
        damages |= {f"array {name}": _within_arrays(change) for name, change in _ARRAYS.items()}
    inner = {**CONTENT_DAMAGES, **_BYTES}
    if suffix in _ARCHIVES:
        damages |= {f"{name} within": _within_archive(change) for name, change in inner.items()}
    if suffix in _PACKED:
        damages |= {f"{name} within": unpacked(_unless_empty(change)) for name, change in inner.items()}
    return {name: _unless_empty(change) for name, change in damages.items()}


def _unless_empty(change: Damage) -> Damage:
    return lambda content, random: change(content, random) if content else random.bytes(16)


def _span(content: bytes, random: np.random.Generator) -> tuple[int, int]:
    """Where a block begins and ends; most are short."""
    start = int(random.integers(len(content)))
    return start, min(len(content), start + 1 + int(2 ** random.uniform(0, 12)))


def _cut_somewhere(content: bytes, random: np.random.Generator) -> bytes:
    return content[: random.integers(len(content))]


def _tail_cut(content: bytes, random: np.random.Generator) -> bytes:
    return content[: -int(random.integers(1, 30))]


def _block_replaced(content: bytes, random: np.random.Generator) -> bytes:
    start, end = _span(content, random)
    return content[:start] + random.bytes(end - start) + content[end:]


def _block_zeroed(content: bytes, random: np.random.Generator) -> bytes:
    start, end = _span(content, random)
    return content[:start] + bytes(end - start) + content[end:]


def _block_removed(content: bytes, random: np.random.Generator) -> bytes:
    start, end = _span(content, random)
    return content[:start] + content[end:]


def _block_repeated(content: bytes, random: np.random.Generator) -> bytes:
    start, end = _span(content, random)
    return content[:end] + content[start:]


def _blocks_swapped(content: bytes, random: np.random.Generator) -> bytes:
    a, b, c = sorted(random.integers(len(content), size=3).tolist())
    return content[:a] + content[b:c] + content[a:b] + content[c:]


def _bytes_flipped(content: bytes, random: np.random.Generator) -> bytes:
    spoiled = bytearray(content)
    for place in random.integers(len(content), size=8):
        spoiled[place] = random.integers(256)
    return bytes(spoiled)


def _line_removed(content: bytes, random: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    del lines[random.integers(len(lines))]
    return b"\n".join(lines)


def _line_repeated(content: bytes, random: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    place = int(random.integers(len(lines)))
    return b"\n".join([*lines[: place + 1], *lines[place:]])


def _single_replaced(by: float) -> Damage:
    """Four bytes are another float32."""

    def replaced(content: bytes, random: np.random.Generator) -> bytes:
        place = int(random.integers(len(content)))
        return content[:place] + np.array(by, "<f4").tobytes() + content[place + 4 :]

    return replaced


def _replaced_by(other: bytes) -> Damage:
    return lambda content, random: other


_BYTES: dict[str, Damage] = {
    "cut somewhere": _cut_somewhere,
    "tail cut": _tail_cut,
    "block of noise": _block_replaced,
    "block of zeros": _block_zeroed,
    "block removed": _block_removed,
    "block repeated": _block_repeated,
    "blocks swapped": _blocks_swapped,
    "bytes flipped": _bytes_flipped,
    "line removed": _line_removed,
    "line repeated": _line_repeated,
    "a web page": _replaced_by(b"<!doctype html><html><body>404 not found</body></html>"),
    "deep brackets": _replaced_by(b"[" * 50_000),
    **{f"single {number}": _single_replaced(number) for number in (np.nan, np.inf, -1e38)},
}


def _resized(suffix: str, size: tuple[float, float] | None) -> Damage:
    """A valid picture of another size."""

    def resized(content: bytes, random: np.random.Generator) -> bytes:
        try:
            with Image.open(io.BytesIO(content)) as picture:
                factors = size or (picture.height / picture.width, picture.width / picture.height)
                width, height = (max(1, round(n * f)) for n, f in zip(picture.size, factors, strict=True))
                changed = picture.resize((width, height), Image.Resampling.NEAREST)
                changed.save(buffer := io.BytesIO(), picture.format)
        except (OSError, ValueError, SyntaxError):  # no picture any more
            return content[::-1]
        return buffer.getvalue()

    return resized


def _with_nan(array: np.ndarray) -> np.ndarray:
    array = array.astype(np.float32)
    array.reshape(-1)[: max(1, array.size // 3)] = np.nan
    return array


_ARRAYS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "transposed": lambda array: array.T,
    "flat": lambda array: array.reshape(-1),
    "half": lambda array: array[: len(array) // 2] if array.ndim else array,
    "empty": lambda array: array.reshape(-1)[:0],
    "of text": lambda array: array.astype(str),
    "of complex numbers": lambda array: array.astype(complex),
    "with NaN": _with_nan,
}


def _within_arrays(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    def changed(content: bytes, random: np.random.Generator) -> bytes:
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as stored:
                arrays = dict(stored)
            name = sorted(arrays)[random.integers(len(arrays))]
            arrays[name] = change(arrays[name])
            np.savez(buffer := io.BytesIO(), **arrays)
        except (ValueError, TypeError, EOFError, OSError, KeyError, zipfile.BadZipFile):  # damaged before
            return content[::-1]
        return buffer.getvalue()

    return changed


def _within_archive(change: Damage) -> Damage:
    """The damage to a member, with the right check sum."""

    def changed(content: bytes, random: np.random.Generator) -> bytes:
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                members = {name: archive.read(name) for name in archive.namelist()}
        except (zipfile.BadZipFile, OSError, ValueError, EOFError, NotImplementedError):  # damaged before
            return content[::-1]
        name = sorted(members)[random.integers(len(members))]
        members[name] = _unless_empty(change)(members[name], random)
        with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
            for member, data in members.items():
                archive.writestr(member, data)
        return buffer.getvalue()

    return changed


def _as_dangling_link(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _folder_removed(path: Path) -> None:
    for each in sorted(path.parent.rglob("*"), reverse=True):
        each.rmdir() if each.is_dir() and not each.is_symlink() else each.unlink()


def _renamed(path: Path) -> None:
    path.rename(path.with_name(f"{path.stem} \x1b[1m copy{path.suffix}"))


def _copied(path: Path) -> None:
    path.with_name(f"{path.stem} (1){path.suffix}").write_bytes(_read(path))
