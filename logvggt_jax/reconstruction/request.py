"""What can be checked before a model is loaded: output, free space, size; and what a run will need."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from logvggt_jax.data.feeding.transforms import check_longer_edge, resized_size
from logvggt_jax.errors import DiskError, InputError
from logvggt_jax.files import check_output
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE
from logvggt_jax.reconstruction.point_cloud import VERTEX, PointFilter
from logvggt_jax.reconstruction.sources import Source
from logvggt_jax.reconstruction.work_folder import is_unfinished

# Of a photograph at the quality that images are kept at, measured on 7-Scenes and procedural rooms; noise takes more.
_JPEG_BYTES_PER_PIXEL = 1.0
# Depth and confidence, float16.
_DEPTH_BYTES_PER_PIXEL = 4.0


def check_request(source: Source, output: str | Path, *, longer_edge: int | None, overwrite: bool) -> Path:
    """The absolute path of the output, if `reconstruct` can begin; for callers that want to know before they load a
    large model. Arguments and errors as in `reconstruct`.
    """
    if longer_edge is not None:
        check_longer_edge(longer_edge)
    target = Path(output).expanduser().resolve()
    if target in (source.path.resolve(), *source.path.resolve().parents):
        raise InputError(f"output {output} contains the source {source.path}: choose another output")
    if overwrite or not is_unfinished(target):
        check_output(target, overwrite=overwrite, marker=CAMERAS_FILE)
    parent = existing_parent(target)
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise DiskError(f"{parent}: no folder can be made there; choose another output or mend its permissions")
    return target


def disk_bytes(source: Source, longer_edge: int, point_filter: PointFilter) -> tuple[int, int] | None:
    """Bytes that a result needs on the disk: a frame, and in all; None where the source does not know its size.

    What is needed in all counts `expected_frames`, or one frame where that is not known.
    """
    if source.image_size is None:
        return None
    height, width = resized_size(source.image_size, longer_edge)
    frame = int(height * width * (_JPEG_BYTES_PER_PIXEL + _DEPTH_BYTES_PER_PIXEL))
    frames = source.expected_frames or 1
    pixels = frames * height * width // point_filter.pixel_stride**2
    points = min(pixels, point_filter.max_points or pixels) * VERTEX.itemsize
    return frame, frames * frame + points


def check_free_space(output: Path, needed: int) -> int:
    """Free bytes where `output` will lie; InputError where they are fewer than `needed`."""
    parent = existing_parent(output)
    free = shutil.disk_usage(parent).free
    if free < needed:
        raise InputError(
            f"{parent}: {free / 1e9:.1f} GB are free, about {needed / 1e9:.1f} GB are needed; make room, choose "
            "another output, or take fewer frames (--stride, --max-frames) or a smaller --longer-edge"
        )
    return free


def existing_parent(path: Path) -> Path:
    """The innermost folder above `path` that is there."""
    return next(parent for parent in path.parents if parent.exists())
