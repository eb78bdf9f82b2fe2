"""From a folder of images or a video to cameras, depth maps and a coloured point cloud on disk."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from logvggt_jax.data.feeding.transforms import LONGER_EDGE, ResizeTransform, check_longer_edge, preprocess
from logvggt_jax.errors import InputError
from logvggt_jax.files import atomic_folder, check_output
from logvggt_jax.geometry import decode_poses
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, write_cameras
from logvggt_jax.reconstruction.depth_files import depth_picture, write_depth, write_jpeg, write_picture
from logvggt_jax.reconstruction.exporters import EXPORTERS
from logvggt_jax.reconstruction.point_cloud import PointFilter
from logvggt_jax.reconstruction.result import (
    DEPTH_FOLDER,
    IMAGE_FOLDER,
    POINTS_FILE,
    PREVIEW_FOLDER,
    TRAJECTORY_FILE,
    Reconstruction,
    depth_file,
    image_file,
)
from logvggt_jax.reconstruction.sources import Source, open_source, read_ahead
from logvggt_jax.streaming import Cameras, ChunkPlan, ChunkSession, FrameResult, StreamSession

_NARROWEST_FIELD_OF_VIEW = 0.01  # radians

_Session = StreamSession | ChunkSession


def check_request(
    source_path: str | Path,
    output: str | Path,
    *,
    longer_edge: int | None = None,
    stride: int = 1,
    max_frames: int | None = None,
    overwrite: bool = False,
) -> Source:
    """The source, if `reconstruct` can begin; for callers that want to know before they load a large model.

    Arguments and errors as in `reconstruct`.
    """
    if longer_edge is not None:
        check_longer_edge(longer_edge)
    source = open_source(source_path, stride=stride, max_frames=max_frames)
    if Path(output).expanduser().resolve() in (source.path.resolve(), *source.path.resolve().parents):
        raise InputError(f"output {output} contains the source {source.path}: choose another output")
    check_output(output, overwrite=overwrite, marker=CAMERAS_FILE)
    return source


def reconstruct(
    source_path: str | Path,
    output: str | Path,
    *,
    model: LogVGGT,
    variables: Variables,
    chunks: ChunkPlan | None = None,
    longer_edge: int = LONGER_EDGE,
    stride: int = 1,
    max_frames: int | None = None,
    point_filter: PointFilter | None = None,
    num_previews: int = 8,
    overwrite: bool = False,
    progress: bool = True,
) -> Reconstruction:
    """Reconstructs a sequence and writes cameras, trajectory, depth and points.

    Frames are read once, as they are needed, and kept at the model's size; depth maps are written as they become
    final. Memory on device and host is constant but for the compact tokens and the cameras; with `chunks` it is that of
    one chunk, and the cameras.

    Args:
      source_path: folder of images or video, see `open_source`.
      output: folder to make; it appears when all is done, until then the work lies beside it in a `.partial` folder.
      model: the model.
      variables: {"params": …}.
      chunks: plain VGGT on overlapping chunks instead of the model's windows, for public VGGT weights; see
        `logvggt_jax.streaming.chunks`.
      longer_edge: size in pixels, a multiple of 14, to which the longer edge of the frames is resized; take
        what the model was trained with (518 for VGGT).
      stride: take every `stride`-th frame.
      max_frames: stop after so many.
      point_filter: which pixels become points.
      num_previews: pictures of frames beside their depth, evenly over the sequence.
      overwrite: replace an earlier reconstruction.
      progress: show progress bars.

    Raises:
      OutputExists: `output` exists.
      InputError: bad source or parameters, or chunks that cannot be aligned; nothing is left behind.
    """
    if num_previews < 0:
        raise InputError(f"num_previews must not be negative, got {num_previews}")
    source = check_request(
        source_path, output, longer_edge=longer_edge, stride=stride, max_frames=max_frames, overwrite=overwrite
    )
    target = Path(output).expanduser().resolve()
    with atomic_folder(target, replace=overwrite) as folder:
        for name in (DEPTH_FOLDER, IMAGE_FOLDER, PREVIEW_FOLDER):
            (folder / name).mkdir()
        started = time.monotonic()
        session: _Session
        session = StreamSession(model, variables) if chunks is None else ChunkSession(model, variables, chunks)
        sequence, cameras = _stream(source, folder, session, longer_edge, progress=progress)
        seconds = time.monotonic() - started
        _write_all_cameras(folder, sequence, cameras)
        result = Reconstruction.with_cameras_of(folder)
        for index in set(np.linspace(0, result.num_frames - 1, num_previews).round().astype(int).tolist()):
            _write_preview(result, index)
        EXPORTERS["tum"](result, folder / TRAJECTORY_FILE)
        EXPORTERS["ply"](result, folder / POINTS_FILE, point_filter=point_filter, progress=progress)
    return dataclasses.replace(result, folder=target, seconds=seconds)


class _Picture(NamedTuple):
    """A frame at the model's size, uint8 [h, w, 3]."""

    name: str
    timestamp: float
    image: np.ndarray
    transform: ResizeTransform


class _Sequence(NamedTuple):
    names: list[str]
    timestamps: list[float]
    transform: ResizeTransform


class _Rate(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        # Rich forgets the speed when the total is corrected, as it is at the end of a video.
        speed = task.finished_speed or task.speed or (task.completed / task.elapsed if task.elapsed else 0.0)
        return Text(f"{speed:.2f} frames/s")


def _pictures(source: Source, longer_edge: int) -> Iterator[_Picture]:
    for frame in source:
        images, transform = preprocess([frame.image], longer_edge=longer_edge)
        # Resizing rounds to grey levels, so that bytes lose nothing and travel at a quarter of the size.
        picture = np.rint(images[0] * 255.0).astype(np.uint8)
        yield _Picture(frame.name, frame.timestamp, picture, transform)


def _stream(
    source: Source, folder: Path, session: _Session, longer_edge: int, *, progress: bool
) -> tuple[_Sequence, Cameras]:
    """Depth and images to disk, as they become final and as they come; cameras at the end."""
    names: list[str] = []
    timestamps: list[float] = []
    transform = None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    with Progress(*columns, disable=not progress) as bars:
        task = bars.add_task("Depth and cameras", total=source.expected_frames)

        def save(results: list[FrameResult]) -> None:
            for result in results:
                write_depth(depth_file(folder, names[result.index]), result.depth, result.confidence)
                bars.advance(task)

        for picture in read_ahead(_pictures(source, longer_edge)):
            names.append(picture.name)
            timestamps.append(picture.timestamp)
            transform = picture.transform
            write_jpeg(image_file(folder, picture.name), picture.image)
            save(session.push(picture.image))
        save(session.close())
        bars.update(task, total=len(names))
    if transform is None:
        raise InputError(f"{source.path} gave no frame")
    return _Sequence(names, timestamps, transform), session.cameras()


def _write_all_cameras(folder: Path, sequence: _Sequence, cameras: Cameras) -> None:
    """Writes cameras whose intrinsics are all finite."""
    encodings = cameras.pose_encoding.copy()
    narrow = encodings[:, 7:] < _NARROWEST_FIELD_OF_VIEW
    if narrow.any():
        # An infinite focal length has no place in files, nor do points that it would put on one line.
        warnings.warn(
            f"{int(narrow.any(1).sum())} of {len(encodings)} frames have no field of view worth the name; "
            f"{_NARROWEST_FIELD_OF_VIEW} rad is written instead. Is the model trained?",
            stacklevel=2,
        )
        encodings[:, 7:] = np.maximum(encodings[:, 7:], _NARROWEST_FIELD_OF_VIEW)
    _, intrinsics = decode_poses(encodings, sequence.transform.size)
    write_cameras(
        folder / CAMERAS_FILE,
        names=sequence.names,
        timestamps=sequence.timestamps,
        extrinsics=cameras.extrinsics,
        intrinsics=sequence.transform.intrinsics_to_original(intrinsics),
        image_size=sequence.transform.original_size,
        model_intrinsics=intrinsics,
        model_size=sequence.transform.size,
    )


def _write_preview(result: Reconstruction, index: int) -> None:
    depth = result.depth(index)
    valid = depth[np.isfinite(depth) & (depth > 0)]
    near, far = np.percentile(valid, (2, 98)) if valid.size else (1.0, 2.0)
    picture = np.concatenate([result.image(index), depth_picture(depth, near=near, far=far)], axis=1)
    write_picture(result.folder / PREVIEW_FOLDER / f"{result.names[index]}.png", picture)
