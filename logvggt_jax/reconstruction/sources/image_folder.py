"""Images of a folder as the frames of a sequence."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from logvggt_jax.data.formats.image import read_rgb
from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.reconstruction.sources.source import Source, SourceFrame, SourceOptions, fingerprint

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
SEVEN_SCENES_COLOUR = (".color.png", ".color.jpg")


class FolderSource(Source):
    """Images of a folder in natural order (`img2` before `img10`).

    A 7-Scenes sequence gives its `*.color.png` or `*.color.jpg` files only; any other folder all its JPEG and
    PNG files. `len` is the number of frames; a frame's file is read when iteration reaches it.

    Args:
      path: the folder.
      options: which images are taken.

    Raises:
      FileNotFoundError: no image in the folder.
      ValueError: while iterating, an image cannot be read, or differs in size from the first.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        super().__init__(path, options)
        with disk_errors(path):
            files = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
        images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
        if not images:
            raise MissingInput(
                f"no image in {path}: expected {', '.join('*' + s for s in IMAGE_SUFFIXES)} files, found "
                f"{len(files)} other files; give the folder that holds the images themselves"
            )
        colour = [file for file in images if file.name.lower().endswith(SEVEN_SCENES_COLOUR)]
        ordered = sorted(colour or images, key=_natural_order)
        names = [_stem(file.name) for file in ordered]
        if len(set(names)) < len(names):
            # 1.jpg beside 1.png: results are named after frames, so that names must differ.
            names = [file.name for file in ordered]
        listing = [
            (float(position), name, file) for position, (name, file) in enumerate(zip(names, ordered, strict=True))
        ]
        self._frames = listing[:: options.stride][: options.max_frames]

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def expected_frames(self) -> int:
        """Number of frames, for progress bars."""
        return len(self)

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(H, W) of the images."""
        return None

    def fingerprint(self, count: int) -> str:
        """Digest of options and files."""
        return fingerprint(self.options, [file for _, _, file in self._frames[:count]])

    def loaders(self, first: int = 0) -> Iterator[Callable[[], SourceFrame | None]]:
        """See `Source.loaders`."""
        opening = self._load(self._frames[0])
        if first == 0:
            yield partial(_itself, opening)
        shape = opening.image.shape
        del opening
        for entry in self._frames[max(first, 1) :]:
            yield partial(self._load, entry, shape)

    def _load(self, entry: tuple[float, str, Path], shape: tuple[int, ...] | None = None) -> SourceFrame:
        """The frame of an entry; its image has the `shape` of the first."""
        timestamp, name, file = entry
        with disk_errors(file):
            image = read_rgb(file)
        if shape is not None and image.shape != shape:
            raise InputError(
                f"{file} is {_size(image.shape)} pixels but {self._frames[0][2].name} is {_size(shape)}: all frames "
                "of a sequence need one size; resize them or put them into folders of their own"
            )
        return SourceFrame(name, timestamp, image)


def _itself(frame: SourceFrame) -> SourceFrame:
    return frame


def _natural_order(file: Path) -> tuple[list[tuple[int, int, str]], str]:
    parts = re.split(r"(\d+)", file.name.lower())
    # Upper and lower case of one name still need an order of their own.
    return [(1, int(p), "") if p.isdecimal() else (0, 0, p) for p in parts], file.name


def _stem(name: str) -> str:
    lower = name.lower()
    for suffix in (*SEVEN_SCENES_COLOUR, *IMAGE_SUFFIXES):
        if lower.endswith(suffix):
            return name[: -len(suffix)]
    return name


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
