"""From a folder of images or a video to cameras, depth maps and a coloured point cloud on disk."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
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

from logvggt_jax.config import check_longer_edge
from logvggt_jax.data.feeding.transforms import LONGER_EDGE, ResizeTransform, resize
from logvggt_jax.errors import InputError
from logvggt_jax.files import atomic_folder, check_output
from logvggt_jax.geometry import decode_poses
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, write_cameras
from logvggt_jax.reconstruction.depth_files import depth_picture, write_depth, write_picture
from logvggt_jax.reconstruction.exporters.ply import write_cloud
from logvggt_jax.reconstruction.exporters.tum import export_tum
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.point_cloud import PointFilter, PointSelection
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
from logvggt_jax.reconstruction.sources import Source, SourceFrame, open_source
from logvggt_jax.streaming import Cameras, FrameResult, Predictor, open_predictor

_NARROWEST_FIELD_OF_VIEW = 0.01  # radians


def check_request(source: Source, output: str | Path, *, longer_edge: int | None, overwrite: bool) -> Path:
    """The absolute path of the output, if `reconstruct` can begin; for callers that want to know before they load a
    large model. Arguments and errors as in `reconstruct`.
    """
    if longer_edge is not None:
        check_longer_edge(longer_edge)
    if Path(output).expanduser().resolve() in (source.path.resolve(), *source.path.resolve().parents):
        raise InputError(f"output {output} contains the source {source.path}: choose another output")
    return check_output(output, overwrite=overwrite, marker=CAMERAS_FILE)


def reconstruct(
    source: Source | str | Path,
    output: str | Path,
    *,
    model: LogVGGT,
    variables: Variables,
    method: str = "windows",
    settings: Any = None,
    longer_edge: int = LONGER_EDGE,
    point_filter: PointFilter | None = None,
    num_previews: int = 8,
    overwrite: bool = False,
    progress: bool = True,
    workers: int | None = None,
) -> Reconstruction:
    """Reconstructs a sequence and writes cameras, trajectory, depth and points.

    Frames are read once, ahead of the model, and kept at its size; depth maps are written as they become final. All
    that is not the model is done by worker threads, whose number changes no result. Memory on the host is constant
    but for the cameras and at most 104 MB of candidates for the point cloud, memory on the device is the method's.

    Args:
      source: folder of images or video; what `open_source` gives chooses among the frames.
      output: folder to make; it appears when all is done, until then the work lies beside it in a `.partial` folder.
      model: the model.
      variables: {"params": …}.
      method: name of `logvggt_jax.streaming.METHODS`; `chunks` for public VGGT weights, see `choose_method`.
      settings: of the method's own settings class; None for its defaults.
      longer_edge: size in pixels, a multiple of 14, to which the longer edge of the frames is resized; take
        what the model was trained with (518 for VGGT).
      point_filter: which pixels become points.
      num_previews: pictures of frames beside their depth, evenly over the sequence.
      overwrite: replace an earlier reconstruction.
      progress: show a progress bar where standard error is a terminal.
      workers: threads beside the one that feeds the device; None for one a core, at most eight.

    Raises:
      OutputExists: `output` exists.
      InputError: bad source or parameters, or a sequence that the method cannot predict; nothing is left behind.
    """
    if num_previews < 0:
        raise InputError(f"num_previews must not be negative, got {num_previews}")
    source = source if isinstance(source, Source) else open_source(source)
    target = check_request(source, output, longer_edge=longer_edge, overwrite=overwrite)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    console = Console(stderr=True)
    bars = Progress(*columns, console=console, disable=not (progress and console.is_terminal))
    with atomic_folder(target, replace=overwrite) as folder, FramePool(workers) as pool, bars:
        for name in (DEPTH_FOLDER, IMAGE_FOLDER, PREVIEW_FOLDER):
            (folder / name).mkdir()
        task = bars.add_task("Depth and cameras", total=source.expected_frames)
        started = time.monotonic()
        selection = PointSelection(point_filter or PointFilter(), source.expected_frames)
        predictor = open_predictor(method, model, variables, settings)
        sequence = _stream(
            source, folder, predictor, pool, selection, longer_edge=longer_edge, advance=lambda: bars.advance(task)
        )
        seconds = time.monotonic() - started
        _write_all_cameras(folder, sequence, predictor.cameras())
        result = Reconstruction.with_cameras_of(folder)
        for index in set(np.linspace(0, result.num_frames - 1, num_previews).round().astype(int).tolist()):
            pool.submit(_write_preview, result, index)
        export_tum(result, folder / TRAJECTORY_FILE)
        bars.reset(task, description="Points", total=result.num_frames)
        write_cloud(result, folder / POINTS_FILE, selection, pool, advance=lambda: bars.advance(task))
        pool.finish()
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


def _stream(
    source: Source,
    folder: Path,
    predictor: Predictor,
    pool: FramePool,
    selection: PointSelection,
    *,
    longer_edge: int,
    advance: Callable[[], object],
) -> _Sequence:
    """The whole sequence through the predictor; images and depth go to disk, and the selection sees all."""
    names: list[str] = []
    timestamps: list[float] = []
    transform = None

    def prepare(load: Callable[[], SourceFrame | None]) -> _Picture | None:
        frame = load()
        if frame is None:
            return None
        image, transform = resize(frame.image, longer_edge=longer_edge)
        write_picture(image_file(folder, frame.name), image)
        return _Picture(frame.name, frame.timestamp, image, transform)

    # Frames whose depth is not final yet.
    images: dict[int, np.ndarray] = {}

    def save(name: str, image: np.ndarray, result: FrameResult) -> None:
        stored = write_depth(depth_file(folder, name), result.depth, result.confidence)
        selection.see(result.index, *stored, image)

    def hand_on(results: list[FrameResult]) -> None:
        for result in results:
            pool.submit(save, names[result.index], images.pop(result.index), result)
            advance()

    for picture in pool.map(prepare, source.loaders()):
        if picture is None:
            continue
        images[len(names)] = picture.image
        names.append(picture.name)
        timestamps.append(picture.timestamp)
        transform = picture.transform
        hand_on(predictor.push(picture.image))
    hand_on(predictor.close())
    pool.finish()
    if transform is None:
        raise InputError(f"{source.path} gave no frame")
    return _Sequence(names, timestamps, transform)


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
