"""What readers of people's own recordings share: which folders are one, the files that a list in it names, and pictures
with lens distortion."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from logvggt_jax.data.errors import AbsurdIntrinsics, missing_files
from logvggt_jax.data.formats.calibration import check_intrinsics
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.formats.source_files import SourceFiles
from logvggt_jax.data.readers.folder_dataset import FrameRecord
from logvggt_jax.errors import InputError

# OpenCV's limit for a side of what it maps.
_MOST_PIXELS = 2**15 - 1
_PICTURE_SUFFIXES = frozenset({".bmp", ".jfif", ".jpe", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})


def is_picture(path: Path) -> bool:
    """Whether a file has a picture's name; hidden ones hold what macOS knows of a picture."""
    return path.suffix.lower() in _PICTURE_SUFFIXES and not path.name.startswith(".")


def find_recordings(
    root: Path, files: SourceFiles, expects: str, is_recording: Callable[[Path], object]
) -> Mapping[str, Path]:
    """The root, where it is a recording itself, else the folders in it that are; named as their folders. Hidden ones,
    such as those of thumbnails, are none."""
    if is_recording(root):
        # A root such as "." has no name of its own.
        return {root.resolve().name: root}
    folders = {name: each for name, each in files.folders(root, expects).items() if not name.startswith(".")}
    return {name: folder for name, folder in folders.items() if is_recording(folder)}


def file_below(folder: Path, name: str, named_by: Path) -> Path:
    """The file of a name in the list `named_by`, with either slash between folders; InputError for a name that leads
    out of the folder."""
    relative = PurePosixPath(name.replace("\\", "/"))
    if relative.is_absolute() or ".." in relative.parts or not relative.name:
        raise InputError(f"{named_by}: {name!r} is no file's name below {folder}: export it again")
    return folder / relative


def pictures_below(folder: Path, names: Iterable[str], named_by: Path) -> list[Path]:
    """The pictures of these names in the list `named_by`; InputError as `file_below`, and for one named twice."""
    paths: dict[Path, None] = {}
    for name in names:
        path = file_below(folder, name, named_by)
        if path in paths:
            raise InputError(f"{named_by}: {name!r} is named twice: remove one of them")
        paths[path] = None
    return list(paths)


def with_suffixes(files: SourceFiles, paths: Iterable[Path], named_by: Path) -> list[Path]:
    """The paths, one without a suffix being the only picture there of that name with one: Blender's scripts and
    instant-ngp leave it out. MissingFiles where a folder is not there."""
    completed = list(paths)
    for folder in {path.parent for path in completed if not path.suffix}:
        held = [folder / name for name in files.names(folder, f"the files that {named_by} names")]
        of_name: dict[Path, list[Path]] = {path: [path] for path in held if not path.suffix}
        for picture in filter(is_picture, held):
            of_name.setdefault(picture.with_suffix(""), []).append(picture)
        chosen = {path: same[0] for path, same in of_name.items() if len(same) == 1 or same[0] == path}
        completed = [path if path.suffix else chosen.get(path, path) for path in completed]
    return completed


def names_beside(files: SourceFiles, paths: Iterable[Path], named_by: Path) -> dict[Path, set[str]]:
    """The names in each folder of the files that the list `named_by` names; MissingFiles for those not there."""
    paths = list(paths)
    names = {
        folder: set(files.names(folder, f"the files that {named_by} names")) for folder in {p.parent for p in paths}
    }
    if absent := [path for path in paths if path.name not in names[path.parent]]:
        raise missing_files(dict.fromkeys(absent, f"but {named_by} names it; copy it there"))
    return names


def without_distortion(
    record: FrameRecord, image: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `_read_frame` returns of a frame's stored picture [H, W, 3] and depth [h, w]: as a pinhole takes them, of
    the same size and with the same `intrinsics` [3, 3], see `Lens.as_pinhole`.

    Raises AbsurdIntrinsics naming the calibration where the picture has nothing of that, InputError naming a picture
    that is too large for OpenCV.
    """
    lens = Lens.of_row(record.lens)
    if lens.is_pinhole or depth.shape != image.shape[:2]:  # which the caller refuses, naming both
        return image, depth, intrinsics
    if max(depth.shape) >= _MOST_PIXELS:
        raise InputError(
            f"{record.image}: {depth.shape[1]} x {depth.shape[0]} pixels with lens distortion, which is taken out of "
            f"less than {_MOST_PIXELS:,} a side: make it smaller"
        )
    check_intrinsics(intrinsics, image.shape[:2], record.image, record.calibration)
    found = lens.as_pinhole(image, depth, intrinsics)
    if found is None:
        raise AbsurdIntrinsics(
            f"{record.calibration}: nothing of {record.image.name} is left without its distortion "
            f"({', '.join(f'{value:g}' for value in lens.coefficients)}): calibrate again"
        )
    return *found, intrinsics
