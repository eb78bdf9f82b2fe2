"""Frames that became final on their way to a result folder: images and depth as they come, all cameras at the end."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.geometry import decode_poses
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, write_cameras
from logvggt_jax.reconstruction.depth_files import (
    DEPTH_FOLDER,
    IMAGE_FOLDER,
    depth_file,
    image_file,
    original_file,
    write_depth,
    write_picture,
)
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.health.recorder import HealthRecorder
from logvggt_jax.reconstruction.health.report import HEALTH_FILE, HEALTH_PAGE, examine, without_harm, write_health
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.sources.record import SourceRecord
from logvggt_jax.reconstruction.watching import LiveResult
from logvggt_jax.streaming import Cameras, FrameResult, Predictor

_NARROWEST_FIELD_OF_VIEW = 0.01  # radians


class Picture(NamedTuple):
    """A frame at the model's size, uint8 [h, w, 3]; where the source has masks with its own, bool [h, w], and without
    what lies under it. `original`, uint8 [H, W, 3], is what the camera gave, where the result is to keep it."""

    name: str
    timestamp: float
    image: np.ndarray
    transform: ResizeTransform
    focal_length: float | None = None
    mask: np.ndarray | None = None
    original: np.ndarray | None = None


class FrameWriter:
    """Writes the frames of one sequence.

    Args:
      folder: to fill.
      pool: whose workers write.
      selection: sees every frame that is written.

    Attributes:
      names, timestamps: of the frames that were added.
      transform: from the original images to the model's; None before the first frame.
      focal_lengths: pixels of the original images, of the frames that were added for which the camera noted one.
      masked: of the frames that were added, the share of the pixels that their mask drops; empty without masks.
      images: of the frames whose depth is not final yet, by position in the sequence.
      health: measures of the frames that are written.
    """

    def __init__(self, folder: Path, pool: FramePool, selection: PointSelection) -> None:
        self._folder, self._pool, self._selection = folder, pool, selection
        self.names: list[str] = []
        self.timestamps: list[float] = []
        self.masked: list[float] = []
        self.transform: ResizeTransform | None = None
        self.focal_lengths: list[float] = []
        self.images: dict[int, np.ndarray] = {}
        self.health = HealthRecorder()
        self._written: set[int] = set()
        for name in (DEPTH_FOLDER, IMAGE_FOLDER):
            (folder / name).mkdir(exist_ok=True)

    def add(self, picture: Picture) -> None:
        """The sequence's next frame, which goes to the method now."""
        self.images[len(self.names)] = picture.image
        self.names.append(picture.name)
        self.timestamps.append(picture.timestamp)
        if picture.mask is not None:
            self.masked.append(1 - float(picture.mask.mean()))
        if picture.original is not None:
            file = original_file(self._folder, picture.name)
            file.parent.mkdir(exist_ok=True)
            self._pool.submit(write_picture, file, picture.original)
        self.transform = picture.transform
        if picture.focal_length:
            self.focal_lengths.append(picture.focal_length)

    def live_result(self, result: FrameResult) -> LiveResult:
        """The frame of a result that is not written yet, for whoever looks on."""
        assert self.transform is not None  # there are frames
        name, timestamp = self.names[result.index], self.timestamps[result.index]
        return LiveResult(name, timestamp, self.images[result.index], self.transform.original_size, result)

    def write(self, results: Sequence[FrameResult]) -> list[Path]:
        """Has the pool write frames whose depth is final; the files it will have written when the pool has finished."""
        files: list[Path] = []
        for result in results:
            name = self.names[result.index]
            depth, image = depth_file(self._folder, name), image_file(self._folder, name)
            files += [depth, image]
            self._pool.submit(self._write, depth, image, self.images.pop(result.index), result)
        return files

    def keep_written(self, most: int) -> int:
        """Gives up all frames but the first ones that are written without a gap, `most` at most; how many they are.

        For a sequence that an error has ended, when the pool has finished.
        """
        count = next(index for index in range(most + 1) if index == most or index not in self._written)
        for name in self.names[count:]:
            for file in (depth_file, image_file, original_file):
                file(self._folder, name).unlink(missing_ok=True)
        del self.names[count:], self.timestamps[count:], self.masked[count:]
        self.images.clear()
        return count

    def write_cameras(
        self,
        cameras: Cameras,
        calibration: Calibration,
        *,
        complete: bool,
        skipped: Sequence[tuple[str, str]] = (),
        source: SourceRecord | None = None,
        timed: bool = True,
    ) -> None:
        """Writes the cameras of all frames, as far as they are known by the calibration; all numbers are finite.

        The other arguments are those of `cameras_file.write_cameras`.
        """
        transform = self.transform
        assert transform is not None  # there are frames
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
        intrinsics = calibration.apply(decode_poses(encodings, transform.size)[1], transform)
        write_cameras(
            self._folder / CAMERAS_FILE,
            names=self.names,
            timestamps=self.timestamps,
            extrinsics=cameras.extrinsics,
            intrinsics=transform.intrinsics_to_original(intrinsics),
            image_size=transform.original_size,
            model_intrinsics=intrinsics,
            model_size=transform.size,
            complete=complete,
            skipped=skipped,
            noted_focal_length=float(np.median(self.focal_lengths)) if self.focal_lengths else None,
            source=source,
            depth_scale=cameras.depth_scale,
            loops=cameras.loops,
            masked=self.masked or None,
            timed=timed,
            point_filter=self._selection.point_filter,
        )

    def write_health(self, result: Reconstruction, predictor: Predictor) -> None:
        """Writes what is to be said of the quality of `result`, whose cameras are written; never raises."""
        with without_harm():
            for name in (HEALTH_FILE, HEALTH_PAGE):  # of an incomplete result
                (result.folder / name).unlink(missing_ok=True)
            measures = self.health.measures(
                size=result.depth_size,
                extrinsics=result.extrinsics,
                intrinsics=result.depth_intrinsics,
                depth_scale=result.depth_scale,
                # What the model saw, whatever calibration was given.
                field_of_view=predictor.cameras().pose_encoding[:, 8].astype(np.float64),
                signals=predictor.signals(),
            )
            write_health(result.folder, examine(measures, result.names), result.names)

    def _write(self, depth: Path, image: Path, pixels: np.ndarray, result: FrameResult) -> None:
        write_picture(image, pixels)
        stored = write_depth(depth, result.depth, result.confidence)
        self._selection.see(result.index, *stored, pixels)
        with without_harm():
            self.health.see(result.index, *stored, pixels)
        self._written.add(result.index)
