"""Frames of a folder or a video, read one at a time."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from logvggt_jax.data.formats.file_kinds import SIGNATURE_BYTES, kind_of
from logvggt_jax.errors import InputError, MissingInput, disk_errors
from logvggt_jax.files import EMPTY_PATH
from logvggt_jax.reconstruction.sources.image_folder import FolderSource
from logvggt_jax.reconstruction.sources.listing import names_pictures
from logvggt_jax.reconstruction.sources.masks import Masks
from logvggt_jax.reconstruction.sources.pictures import IMAGE_SUFFIXES
from logvggt_jax.reconstruction.sources.source import SkippedFrame, Source, SourceFrame, SourceOptions
from logvggt_jax.reconstruction.sources.video import VideoSource, is_live, refuse_address

__all__ = ["FolderSource", "SkippedFrame", "Source", "SourceFrame", "SourceOptions", "VideoSource", "open_source"]


_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
# How FFmpeg and OpenCV are told of a sequence of images.
_NUMBER = re.compile(r"%0?\d*d")
_EXPECTED = "expected a folder of images or a video file"
# As file managers give it; a `Path` keeps one slash only.
_FILE_ADDRESS = re.compile(r"file:(?://(?:localhost)?)?(/[^/].*)")


def _is_video(path: Path) -> bool:
    """Whether a file is a video by its content."""
    with disk_errors(path):
        if not path.is_file():  # a pipe would be waited for
            return False
        with path.open("rb") as file:
            return kind_of(file.read(SIGNATURE_BYTES)) == "video"


def open_source(path: str | Path, *, masks: str | Path | None = None, **options: Any) -> Source:
    """A folder of images or a video as a `Source`.

    Args:
      path: folder, glob (`photos/*.jpg`) or list of image files (a text file with a path a line); video file, number of
        a camera (`0`), or address of a network stream (`rtsp://…`).
      masks: folder with a mask for each frame, or one picture for all, black where nothing is to be seen; see `Masks`.
      options: those of `SourceOptions`: which frames are taken.

    Raises:
      MissingInput: nothing is there, or the folder holds no image; a frame has no mask.
      InputError: the file is no video, or an option is out of range.
    """
    chosen, of_frames = SourceOptions(**options), None if masks is None else Masks(masks)
    if is_live(path):
        return VideoSource(path, chosen, of_frames)
    given = path
    if not str(path):
        raise InputError(f"{EMPTY_PATH}: {_EXPECTED}")
    if (address := _FILE_ADDRESS.fullmatch(str(path))) and not Path(path).exists():
        given = path = unquote(address[1])
    try:
        path = Path(path).expanduser()
        pictures = names_pictures(path)
        if not pictures:
            with disk_errors(path):
                path.stat()
    except MissingInput as error:
        refuse_address(given)
        glob = _NUMBER.sub("*", str(path))
        hint = "" if glob == str(path) else f"; a sequence with numbers is given as a glob, '{glob}'"
        raise MissingInput(f"{path} does not exist: {_EXPECTED}{hint}") from error
    except (RuntimeError, ValueError) as error:
        # No such user, or a null character.
        raise error if isinstance(error, InputError) else InputError(f"{given!r} is no path: {error}") from error
    if pictures:
        return FolderSource(path, chosen, of_frames)
    if path.suffix.lower() in IMAGE_SUFFIXES and not _is_video(path):
        raise InputError(
            f"{path} is a single image, or an animation (make it an mp4 or a GIF): give the folder that holds the "
            "sequence, a glob, or a video"
        )
    if path.suffix.lower() in _ARCHIVES:
        raise InputError(f"{path} is an archive: unpack it, and give the folder of the images or the video in it")
    return VideoSource(path, chosen, of_frames)
