"""Masks of a sequence's frames: pictures that are black where nothing is to be seen, as COLMAP has them."""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import user_path
from logvggt_jax.frames import evenly_spaced
from logvggt_jax.reconstruction.sources.headers import read_header
from logvggt_jax.reconstruction.sources.listing import some, stem
from logvggt_jax.reconstruction.sources.pictures import IMAGE_SUFFIXES, read_not_black, upright

# The number at the end of a name, of a video's frame.
_NUMBER = re.compile(r"(?:.*\D)?(\d+)")
# Masks that are looked at when a source is opened, evenly over the sequence.
_LOOKED_AT = 16
# The masked share of the pixels from which an inverted mask is more likely than a crowd.
_SUSPICIOUS = 0.8
_INVERTED = "black is what is left out, are they inverted?"


class Masked(NamedTuple):
    """A frame that needs a mask.

    Attributes:
      name: of the frame.
      file: name of its file; empty for a video's.
      size: (H, W), upright.
      orientation: EXIF orientation that its pixels are turned by, 1 to 8.
    """

    name: str
    file: str
    size: tuple[int, int]
    orientation: int = 1


class Masks:
    """A mask for each frame in a folder, or one picture for all.

    What is black or transparent is masked, all else counts; in formats that lose detail, as JPEG, what is darker than
    half. A mask is called after its frame's file, `NAME.png` or `NAME.jpg.png`; for a video after the frame's position,
    counted from 0: `000123.png` or `frame-000123.png`. It has the size of its frame: of the upright picture, or of the
    pixels as they are stored, which are turned as the frame's are.

    Args:
      path: the folder, or the picture for all frames.

    Attributes:
      path: the same.

    Raises:
      MissingInput: nothing is there, or the folder holds no picture.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = user_path(path)
        self._files: dict[str, Path] = {}  # by name without suffix
        self._of_frame: dict[str, Path] = {}
        with disk_errors(self.path):
            if not self.path.exists():
                raise MissingInput(f"{path} does not exist: expected a folder of masks, or one mask for all frames")
            self._for_all = not self.path.is_dir()
            entries = [] if self._for_all else sorted(self.path.iterdir())
        for entry in entries:
            if entry.suffix.lower() in IMAGE_SUFFIXES and not entry.name.startswith(".") and entry.is_file():
                other = self._files.setdefault(stem(entry.name), entry)
                if other != entry:
                    raise InputError(f"{other} and {entry.name} are masks of one frame: keep one of them")
        if not self._for_all and not self._files:
            raise MissingInput(f"no mask in {path}: expected a picture a frame, such as NAME.png or NAME.jpg.png")
        self._header_size = functools.lru_cache(1)(lambda file: read_header(file).size)
        self._read = functools.lru_cache(4 if self._for_all else 0)(self._decoded)

    def check(self, frames: Sequence[Masked]) -> str:
        """Finds the masks of all frames, looks at their sizes, and at the pixels of some.

        Returns:
          A note on how much is masked.

        Raises:
          MissingInput: frames without a mask.
          InputError: a mask of another size, damaged, or no picture; two masks of one frame; nothing is left to see.
        """
        if not self._for_all:
            self._match_names(frames)
        return self._looked_at(frames)

    def check_video(self, size: tuple[int, int], *, from_start: bool) -> str:
        """As `check`, for a video of frames of (H, W) pixels, whose names are known as they are decoded only.

        Args:
          size: of the frames. All masks need it.
          from_start: whether the video is read from its first frame on, which then needs a mask.
        """
        if self._for_all:
            return self._looked_at([Masked("frame-000000", "", size)])
        self._match_numbers()
        if from_start or not self._of_frame:
            self.file("frame-000000")
        return self._looked_at([Masked(name, "", size) for name in sorted(self._of_frame)], from_start=from_start)

    def check_live(self) -> None:
        """InputError for a folder: nobody knows the frames of a camera or a network stream before they come."""
        if not self._for_all:
            raise InputError(f"{self.path} is a folder: a camera or a stream takes one mask, a picture, for all frames")

    def files(self) -> Iterator[Path]:
        """The picture, or the folder and what is in it."""
        yield self.path
        yield from self._files.values()

    def file(self, name: str) -> Path:
        """The mask of the frame of this name. MissingInput where a video's frame has none."""
        if self._for_all:
            return self.path
        if name not in self._of_frame:
            raise MissingInput(
                f"no mask in {self.path} for {name}: masks of a video's frames are named after their positions, "
                f"counted from 0, such as {name}.png; a frame that counts whole needs a white one"
            )
        return self._of_frame[name]

    def read(self, frame: Masked) -> np.ndarray:
        """The mask of a frame, bool [H, W], upright, True where the frame counts; not to be written to.

        Raises:
          MissingInput: there is none.
          InputError: another size, damaged, or no picture.
        """
        return self._read(self.file(frame.name), frame.size, frame.orientation)

    def fingerprint(self, names: Sequence[str]) -> str:
        """Digest of what decides the masks of these frames: names, sizes and times of change of their files."""
        files = [self.path] if self._for_all else [self.file(name) for name in names]
        with disk_errors(self.path):
            stated = [(str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
        return hashlib.blake2b(json.dumps(stated).encode(errors="surrogateescape"), digest_size=16).hexdigest()

    def _match_names(self, frames: Sequence[Masked]) -> None:
        missing = []
        for frame in frames:
            file = self._files.get(frame.file) or self._files.get(frame.name) or self._files.get(stem(frame.file))
            if file is None:
                missing.append(frame)
            else:
                self._of_frame[frame.name] = file
        if not missing:
            return
        expected = f"expected {stem(missing[0].file)}.png or {missing[0].file}.png"
        if len(missing) == len(frames):
            found = some(file.name for file in self._files.values())
            raise MissingInput(f"no mask in {self.path} is named after a frame: {expected}, found {found}")
        raise MissingInput(
            f"no mask in {self.path} for {len(missing)} of {len(frames)} frames "
            f"({some(frame.file for frame in missing)}): {expected}; a frame that counts whole needs a white one"
        )

    def _match_numbers(self) -> None:
        for name, file in self._files.items():
            if (found := _NUMBER.fullmatch(stem(name))) is None:
                continue
            other = self._of_frame.setdefault(f"frame-{int(found[1]):06d}", file)
            if other != file:
                raise InputError(f"{other} and {file.name} are masks of one frame: keep one of them")

    def _looked_at(self, frames: Sequence[Masked], *, from_start: bool = True) -> str:
        """The note on the masks of these frames; `from_start` says that the first of them comes first."""
        for frame in frames:
            file = self.file(frame.name)
            _check_size(file, self._header_size(file), frame)
        chosen = [frames[place] for place in evenly_spaced(len(frames), 1 if self._for_all else _LOOKED_AT)]
        shares = [1 - float(self.read(frame).mean()) for frame in chosen]
        if min(shares) == 1:
            raise InputError(f"{self.path}: everything is masked; {_INVERTED}")
        if from_start and shares[0] == 1:
            raise InputError(
                f"{self.file(chosen[0].name)}: the first frame is masked whole, and the world is its camera's: begin "
                f"with another frame; {_INVERTED}"
            )
        share, count = float(np.mean(shares)), "" if self._for_all else f" ({len(shares)} masks were looked at)"
        doubt = f"; {_INVERTED}" if share > _SUSPICIOUS else ""
        return f"{share:.0%} of the pixels are masked, black in {self.path}{count}{doubt}"

    @staticmethod
    def _decoded(file: Path, size: tuple[int, int], orientation: int) -> np.ndarray:
        own = read_header(file).orientation
        kept = read_not_black(file, orientation=own)
        _check_size(file, kept.shape, Masked(file.name, "", size, orientation))
        if own == 1 and kept.shape == _as_stored(size, orientation):
            kept = upright(kept, orientation)
        kept.flags.writeable = False
        return kept


def _as_stored(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    return (size[1], size[0]) if orientation in (5, 6, 7, 8) else size


def _check_size(file: Path, size: tuple[int, ...], frame: Masked) -> None:
    if size not in (frame.size, _as_stored(frame.size, frame.orientation)):
        raise InputError(
            f"{file} is {size[1]} x {size[0]} pixels, its frame {frame.size[1]} x {frame.size[0]}: a mask needs the "
            "size of its frame"
        )
