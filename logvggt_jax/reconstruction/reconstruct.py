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

from logvggt_jax.data.feeding.transforms import ResizeTransform, preprocess
from logvggt_jax.files import atomic_folder, check_output
from logvggt_jax.geometry import decode_poses
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.reconstruction.depth_files import (
    as_stored,
    depth_picture,
    read_depth,
    write_depth,
    write_picture,
)
from logvggt_jax.reconstruction.point_cloud import (
    PointFilter,
    PointSelection,
    frame_vertices,
    write_point_cloud,
)
from logvggt_jax.reconstruction.sources import Source, open_source, read_ahead
from logvggt_jax.reconstruction.trajectory_files import write_cameras, write_trajectory
from logvggt_jax.streaming.chunk_session import ChunkSession
from logvggt_jax.streaming.chunks import ChunkPlan
from logvggt_jax.streaming.windows import Cameras, FrameResult, StreamSession

CAMERAS_FILE = "cameras.json"
TRAJECTORY_FILE = "trajectory.txt"
POINTS_FILE = "points.ply"
DEPTH_FOLDER = "depth"
PREVIEW_FOLDER = "previews"

_NARROWEST_FIELD_OF_VIEW = 0.01  # radians

_Session = StreamSession | ChunkSession


@dataclasses.dataclass(frozen=True)
class Reconstruction:
    """What `reconstruct` has written.

    Attributes:
      folder: the output folder.
      num_frames: frames of the sequence.
      num_points: points of the cloud.
      depth_size: (H, W) of the depth maps.
      seconds: time from the first frame to the last depth map, compilation included.
    """

    folder: Path
    num_frames: int
    num_points: int
    depth_size: tuple[int, int]
    seconds: float

    def summary(self) -> str:
        """One line a result, with its place."""
        height, width = self.depth_size
        lines = [
            (CAMERAS_FILE, f"intrinsics and world-to-camera extrinsics of {self.num_frames} frames"),
            (TRAJECTORY_FILE, "camera-to-world trajectory, TUM format"),
            (f"{DEPTH_FOLDER}/*.npz", f"depth and confidence, {height} x {width}, float16"),
            (PREVIEW_FOLDER + "/*.png", "some images beside their depth"),
            (POINTS_FILE, f"{self.num_points:,} coloured points"),
        ]
        rate = f"{self.num_frames} frames in {self.seconds:.1f} s ({self.num_frames / self.seconds:.2f} frames/s)"
        return "\n".join([rate, *(f"  {self.folder / name}: {what}" for name, what in lines)])


def check_request(
    source_path: str | Path,
    output: str | Path,
    *,
    stride: int = 1,
    max_frames: int | None = None,
    overwrite: bool = False,
) -> Source:
    """The source, if `reconstruct` can begin; for callers that want to know before they load a large model.

    Arguments and errors as in `reconstruct`.
    """
    source = open_source(source_path, stride=stride, max_frames=max_frames)
    if Path(output).expanduser().resolve() in (source.path.resolve(), *source.path.resolve().parents):
        raise ValueError(f"output {output} contains the source {source.path}: choose another output")
    check_output(output, overwrite=overwrite, marker=CAMERAS_FILE)
    return source


def reconstruct(
    source_path: str | Path,
    output: str | Path,
    *,
    model: LogVGGT,
    variables: Variables,
    chunks: ChunkPlan | None = None,
    longer_edge: int = 518,
    stride: int = 1,
    max_frames: int | None = None,
    point_filter: PointFilter | None = None,
    num_previews: int = 8,
    overwrite: bool = False,
    progress: bool = True,
) -> Reconstruction:
    """Reconstructs a sequence and writes cameras, trajectory, depth and points.

    Frames are read as they are needed, and depth maps are written as they become final; the frames are read a
    second time for the colours of the points, when all poses are final. Memory on device and host is constant but
    for the compact tokens and the cameras; with `chunks` it is that of one chunk, and the cameras.

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
      FileExistsError: `output` exists.
      FileNotFoundError, ValueError: bad source or parameters, or chunks that cannot be aligned; nothing is left
        behind.
    """
    point_filter = point_filter or PointFilter()
    if num_previews < 0:
        raise ValueError(f"num_previews must not be negative, got {num_previews}")
    source = check_request(source_path, output, stride=stride, max_frames=max_frames, overwrite=overwrite)
    target = Path(output).expanduser().resolve()
    with (
        atomic_folder(target, replace=overwrite) as folder,
        Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TimeRemainingColumn(),
            disable=not progress,
        ) as bars,
    ):
        (folder / DEPTH_FOLDER).mkdir()
        (folder / PREVIEW_FOLDER).mkdir()
        selection = PointSelection(point_filter)
        started = time.monotonic()
        session: _Session
        session = StreamSession(model, variables) if chunks is None else ChunkSession(model, variables, chunks)
        sequence, cameras = _stream(source, folder, session, longer_edge, selection, bars)
        seconds = time.monotonic() - started
        intrinsics = _write_all_cameras(folder, sequence, cameras)
        previews = set(np.linspace(0, len(sequence.names) - 1, num_previews).round().astype(int).tolist())
        vertices = _vertices(
            source, folder, longer_edge, sequence, cameras.extrinsics, intrinsics, selection, previews, bars
        )
        num_points = write_point_cloud(folder / POINTS_FILE, vertices)
    return Reconstruction(target, len(sequence.names), num_points, sequence.transform.size, seconds)


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
    source: Source,
    folder: Path,
    session: _Session,
    longer_edge: int,
    selection: PointSelection,
    bars: Progress,
) -> tuple[_Sequence, Cameras]:
    """First pass: depth to disk, candidate points counted, cameras at the end."""
    names: list[str] = []
    timestamps: list[float] = []
    task = bars.add_task("Depth and cameras", total=source.expected_frames)
    transform = None

    def save(results: list[FrameResult]) -> None:
        for result in results:
            write_depth(_depth_file(folder, names[result.index]), result.depth, result.confidence)
            selection.count(*as_stored(result.depth, result.confidence))
            bars.advance(task)

    for picture in read_ahead(_pictures(source, longer_edge)):
        names.append(picture.name)
        timestamps.append(picture.timestamp)
        transform = picture.transform
        save(session.push(picture.image))
    save(session.close())
    if transform is None:
        raise ValueError(f"{source.path} gave no frame")
    bars.update(task, total=len(names))
    return _Sequence(names, timestamps, transform), session.cameras()


def _write_all_cameras(folder: Path, sequence: _Sequence, cameras: Cameras) -> np.ndarray:
    """Writes trajectory and cameras; returns the depth maps' intrinsics [T, 3, 3], all finite."""
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
    write_trajectory(folder / TRAJECTORY_FILE, sequence.timestamps, cameras.extrinsics)
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
    return intrinsics


def _vertices(
    source: Source,
    folder: Path,
    longer_edge: int,
    sequence: _Sequence,
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    selection: PointSelection,
    previews: set[int],
    bars: Progress,
) -> Iterator[np.ndarray]:
    """Second pass: the chosen points of one frame after the other; pictures of some frames on the way."""
    task = bars.add_task("Points", total=len(sequence.names))
    index = 0
    for picture in read_ahead(_pictures(source, longer_edge)):
        if index >= len(sequence.names) or picture.name != sequence.names[index]:
            raise ValueError(f"{source.path} changed while it was read: frame {picture.name} is new")
        depth, confidence = read_depth(_depth_file(folder, picture.name))
        if index in previews:
            _write_preview(folder / PREVIEW_FOLDER / f"{picture.name}.png", picture.image, depth)
        chosen = selection.choose(depth, confidence)
        yield frame_vertices(depth, picture.image, intrinsics[index], extrinsics[index], chosen)
        bars.advance(task)
        index += 1
    if index < len(sequence.names):
        raise ValueError(f"{source.path} changed while it was read: frame {sequence.names[index]} is gone")


def _write_preview(path: Path, image: np.ndarray, depth: np.ndarray) -> None:
    valid = depth[np.isfinite(depth) & (depth > 0)]
    near, far = np.percentile(valid, (2, 98)) if valid.size else (1.0, 2.0)
    write_picture(path, np.concatenate([image, depth_picture(depth, near=near, far=far)], axis=1))


def _depth_file(folder: Path, name: str) -> Path:
    return folder / DEPTH_FOLDER / f"{name}.npz"
