"""Formats that a reconstruction can be written in: one file each, and its line in the registry.

An exporter is called with the reconstruction, the path to write, and as keywords the `PointFilter` that says which
pixels become points (None: the result's filter, for the format's own number of points), and whether to show progress;
it uses what its format holds. It reads the reconstruction through its handle and nothing else.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

from logvggt_jax.data.formats.nerfstudio_transforms import TRANSFORMS_FILE
from logvggt_jax.errors import InputError, OutputExists, disk_errors
from logvggt_jax.files import (
    FolderKind,
    atomic_folder,
    check_output,
    check_space,
    check_writable,
    foreign_entries,
    user_path,
)
from logvggt_jax.reconstruction.exporters.colmap import export_colmap, export_colmap_text
from logvggt_jax.reconstruction.exporters.depth_exr import export_depth_exr
from logvggt_jax.reconstruction.exporters.depth_npz import export_depth_npz
from logvggt_jax.reconstruction.exporters.depth_png import export_depth_png
from logvggt_jax.reconstruction.exporters.euroc import export_euroc
from logvggt_jax.reconstruction.exporters.glb import export_glb
from logvggt_jax.reconstruction.exporters.kitti import export_kitti
from logvggt_jax.reconstruction.exporters.libraries import check_library
from logvggt_jax.reconstruction.exporters.nerfstudio import export_nerfstudio
from logvggt_jax.reconstruction.exporters.original_depth import DEPTH_INDEX
from logvggt_jax.reconstruction.exporters.pictures import picture_size
from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.exporters.rosbag import export_rosbag
from logvggt_jax.reconstruction.exporters.splats import export_splats
from logvggt_jax.reconstruction.exporters.tum import export_tum
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.result_folder import EXPORT_FOLDER


class Exporter(Protocol):
    """Writes a reconstruction in one format."""

    def __call__(
        self, result: Reconstruction, path: Path, *, point_filter: PointFilter | None = None, progress: bool = True
    ) -> None:
        """Writes the file `path`, whole or not at all, or fills `path`, an empty folder."""


@dataclasses.dataclass(frozen=True)
class Format:
    """A format of exports.

    Attributes:
      write: the exporter.
      file: name of the file or folder that an export makes.
      folder: what such a folder holds; None where a format is one file.
      needs: the library that it is written with; None for this package's own means.
      picture_bytes: of the pictures that it writes, about, for each pixel of theirs.
      depth_bytes: of its depth, about, for each pixel of the original images, on which it lies, as measured on smooth
        surfaces in single precision.
    """

    write: Exporter
    file: str
    folder: FolderKind | None = None
    needs: str | None = None
    picture_bytes: float = 0.0
    depth_bytes: float = 0.0


# At the quality that pictures are written at.
_JPEG = 1.0
_COLMAP, _COLMAP_TEXT = (
    FolderKind(f"sparse/0/cameras.{suffix}", ("sparse", "images", "masks")) for suffix in ("bin", "txt")
)
_NERFSTUDIO = FolderKind(TRANSFORMS_FILE, (TRANSFORMS_FILE, "images", "masks", "points.ply"))
_PNG, _EXR, _NPZ = (FolderKind(DEPTH_INDEX, (DEPTH_INDEX, f"*.{suffix}")) for suffix in ("png", "exr", "npz"))
_BAG = FolderKind("metadata.yaml", ("metadata.yaml", "*.db3", "*.mcap"))

EXPORTERS: dict[str, Format] = {
    "colmap": Format(export_colmap, "colmap", _COLMAP, "pycolmap", _JPEG),
    "colmap-text": Format(export_colmap_text, "colmap-text", _COLMAP_TEXT, "pycolmap", _JPEG),
    "nerfstudio": Format(export_nerfstudio, "nerfstudio", _NERFSTUDIO, picture_bytes=_JPEG),
    "glb": Format(export_glb, "scene.glb", needs="trimesh"),
    "ply": Format(export_ply, "points.ply"),
    "splats": Format(export_splats, "splats.ply"),
    "tum": Format(export_tum, "tum.txt"),
    "kitti": Format(export_kitti, "kitti.txt"),
    "euroc": Format(export_euroc, "euroc.csv"),
    "depth-png": Format(export_depth_png, "depth-png", _PNG, depth_bytes=1.5),
    "depth-exr": Format(export_depth_exr, "depth-exr", _EXR, "OpenEXR", depth_bytes=3.9),
    "depth-npz": Format(export_depth_npz, "depth-npz", _NPZ, depth_bytes=3.6),
    "rosbag2": Format(export_rosbag, "rosbag2", _BAG, "rosbags", _JPEG, depth_bytes=4.0),
}
"""Formats by name."""


def check_formats(names: Sequence[str]) -> None:
    """InputError for a name of no format, MissingPackage for one whose library is not installed."""
    for name in names:
        if name not in EXPORTERS:
            raise InputError(f"there is no format {name!r}: choose among {', '.join(EXPORTERS)}")
        if (library := EXPORTERS[name].needs) is not None:
            check_library(library)


def check_exports(folder: Path) -> None:
    """Raises OutputExists where something lies among a result's exports, in its `folder`, that no export has made: it
    would be deleted with the result."""
    exports = folder / EXPORT_FOLDER
    if not exports.is_dir():
        return
    kinds = {kind.file: kind.folder for kind in EXPORTERS.values()}
    found = [exports / name for name in foreign_entries(exports, kinds)]
    for name, kind in kinds.items():
        if kind is not None and (exports / name).is_dir():
            found += [exports / name / entry for entry in foreign_entries(exports / name, kind.names)]
    if found:
        raise OutputExists(
            f"{folder} is not overwritten: {found[0]} is not of an export, and would be deleted; move it elsewhere, or "
            "choose another output"
        )


def frame_bytes(names: Iterable[str], pictures: tuple[int, int], depth: tuple[int, int]) -> int:
    """Bytes of disk, about, that a frame takes in these formats, with pictures and depth of these sizes (H, W)."""
    formats = [EXPORTERS[name] for name in set(names)]
    of_pictures = math.prod(pictures) * sum(kind.picture_bytes for kind in formats)
    return int(of_pictures + math.prod(depth) * sum(kind.depth_bytes for kind in formats))


def export(
    result: Reconstruction,
    names: Sequence[str] | str,
    output: str | Path | None = None,
    *,
    point_filter: PointFilter | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> list[Path]:
    """Writes a result in some formats; each is a file or folder of `output` that appears when it is whole.

    All that can be checked is checked before the first is written. The result itself is only read.

    Args:
      result: the reconstruction.
      names: keys of `EXPORTERS`, or a single one.
      output: folder, made if need be; None for `exports` of the result's own.
      point_filter: which pixels become points; None takes the result's filter, for each format's own number of points.
      overwrite: replace earlier exports.
      progress: show progress bars where standard error is a terminal.

    Returns:
      What was written, in the order of the names.

    Raises:
      InputError: no such format, the output is the result's own folder or one of those in it, or a file of the result
        is damaged.
      MissingPackage: the library of a format is not installed.
      OutputExists: something is at a place where a format has to go.
      DiskError: the disk has too little room for pictures and depth, or cannot be written.
    """
    names = [names] if isinstance(names, str) else list(dict.fromkeys(names))
    check_formats(names)
    folder = result.folder / EXPORT_FOLDER if output is None else user_path(output)
    inside, own = folder.resolve(), result.folder.resolve()
    if inside.is_relative_to(own) and not inside.is_relative_to(own / EXPORT_FOLDER):
        raise InputError(
            f"{folder} is the result itself, or lies among its own files: choose another output, or "
            f"{own / EXPORT_FOLDER}"
        )
    targets = [_checked(folder / EXPORTERS[name].file, EXPORTERS[name], overwrite) for name in names]
    drawn = any(EXPORTERS[name].picture_bytes for name in names)
    pictures = picture_size(result) if drawn else result.depth_size
    mend = "make room, choose another output, or fewer formats"
    check_space(folder.absolute(), result.num_frames * frame_bytes(names, pictures, result.image_size), mend)
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name, target in zip(names, targets, strict=True):
        write = EXPORTERS[name].write
        if EXPORTERS[name].folder is None:
            write(result, target, point_filter=point_filter, progress=progress)
            continue
        with atomic_folder(target, replace=overwrite) as partial, disk_errors(target):
            write(result, partial, point_filter=point_filter, progress=progress)
    return targets


def _checked(target: Path, kind: Format, overwrite: bool) -> Path:
    """The absolute path of an export, if it can go there."""
    if kind.folder is not None:
        target = check_output(target, overwrite=overwrite, kind=kind.folder)
    else:
        target = target.absolute()
        with disk_errors(target):
            if target.exists() and not (overwrite and target.is_file()):
                mend = "choose another output" if target.is_dir() else "pass --overwrite to replace it"
                raise OutputExists(f"{target} exists: {mend}")
    check_writable(target)
    return target
