"""A sequence on its way through a method: frames in, depth to disk, and the state saved now and then."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from logvggt_jax.data.feeding.transforms import ResizeTransform, resize
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import decode_poses
from logvggt_jax.interruption import Interrupted, StopRequest
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE, write_cameras
from logvggt_jax.reconstruction.depth_files import write_depth, write_picture
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.health.recorder import HealthRecorder
from logvggt_jax.reconstruction.health.report import (
    HEALTH_FILE,
    HEALTH_PAGE,
    examine,
    without_harm,
    write_health,
)
from logvggt_jax.reconstruction.point_cloud import PointSelection
from logvggt_jax.reconstruction.result import DEPTH_FOLDER, IMAGE_FOLDER, Reconstruction, depth_file, image_file
from logvggt_jax.reconstruction.sources import SkippedFrame, Source, SourceFrame
from logvggt_jax.reconstruction.sources.record import record_source
from logvggt_jax.reconstruction.work_folder import WorkFolder
from logvggt_jax.streaming import FrameResult, Predictor, Progress
from logvggt_jax.streaming.state_file import State

_NARROWEST_FIELD_OF_VIEW = 0.01  # radians
# Saving takes at most this share of the time.
_SAVING = 0.05


class _Picture(NamedTuple):
    """A frame at the model's size, uint8 [h, w, 3]."""

    name: str
    timestamp: float
    image: np.ndarray
    transform: ResizeTransform
    focal_length: float | None


class Run:
    """One run over a source; takes up the state that `work` holds, if it holds one.

    Args:
      source: of the frames.
      work: the folder to fill.
      predictor: the method, which has seen no frame.
      pool: does all that is not the model.
      selection: sees every frame whose depth is final.
      longer_edge: of the model's images, in pixels.
      save_seconds: time between two saved states, at least.

    Raises:
      InputError: the source has changed since the state was saved, or the state is damaged.
    """

    def __init__(
        self,
        *,
        source: Source,
        work: WorkFolder,
        predictor: Predictor,
        pool: FramePool,
        selection: PointSelection,
        longer_edge: int,
        save_seconds: float,
    ) -> None:
        self._source, self._work, self._predictor, self._pool = source, work, predictor, pool
        self.selection, self._longer_edge = selection, longer_edge
        self._save_seconds = save_seconds
        self._last_save, self._saving = time.monotonic(), 0.0
        self._names: list[str] = []
        self._timestamps: list[float] = []
        self._health = HealthRecorder()
        self._transform: ResizeTransform | None = None
        self._focal_length: float | None = None
        # Frames whose depth is not final yet.
        self._images: dict[int, np.ndarray] = {}
        # Written since the last save.
        self._files: list[Path] = []
        self.num_taken = 0
        for name in (DEPTH_FOLDER, IMAGE_FOLDER):
            (work.path / name).mkdir(exist_ok=True)
        if (saved := work.saved()) is not None:
            self._restore(saved)

    def stream(self, stop: StopRequest, *, advance: Callable[[], object], refined: Progress) -> bool:
        """The rest of the sequence through the predictor; images and depth go to disk, and the selection sees all.

        Args:
          stop: asks for an early end.
          advance: called with every frame taken.
          refined: told how far a long refinement at the end has come.

        Returns:
          Whether the source was read to its end; False if SIGINT ended the sequence.

        Raises:
          Interrupted: by another signal, or before any frame.
        """
        for picture in self._pictures():
            self.num_taken += 1
            if picture is not None:
                self._images[len(self._names)] = picture.image
                self._names.append(picture.name)
                self._timestamps.append(picture.timestamp)
                self._transform, self._focal_length = picture.transform, picture.focal_length or self._focal_length
                self._hand_on(self._predictor.push(picture.image))
            advance()
            if stop.reason:
                break
            if time.monotonic() - self._last_save > max(self._save_seconds, self._saving / _SAVING):
                self._save()
        if stop.reason and not self._names:
            raise Interrupted(stop.reason, "no frame had been read yet")
        if stop.reason:
            self._save()
        if stop.reason not in (None, "SIGINT"):
            kept = f"{self._predictor.num_frames} frames are kept in {self._work.path}"
            raise Interrupted(stop.reason, f"{kept}; the same command goes on from there")
        self._hand_on(self._predictor.close(refined))
        self._pool.finish()
        if not self._names:
            raise InputError(f"{self._source.path} gave no frame")
        return stop.reason is None

    def write_cameras(self, calibration: Calibration, *, complete: bool) -> None:
        """Writes the cameras of all frames, as far as they are known by the calibration; all numbers are finite."""
        cameras, transform = self._predictor.cameras(), self._transform
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
            self._work.path / CAMERAS_FILE,
            names=self._names,
            timestamps=self._timestamps,
            extrinsics=cameras.extrinsics,
            intrinsics=transform.intrinsics_to_original(intrinsics),
            image_size=transform.original_size,
            model_intrinsics=intrinsics,
            model_size=transform.size,
            complete=complete,
            skipped=self._source.skipped,
            noted_focal_length=self._focal_length,
            source=record_source(self._source, self.num_taken),
            depth_scale=cameras.depth_scale,
            loops=cameras.loops,
        )

    def write_health(self, result: Reconstruction) -> None:
        """Writes what is to be said of the quality of `result`, whose cameras are written; never raises."""
        with without_harm():
            for name in (HEALTH_FILE, HEALTH_PAGE):  # of an incomplete result
                (result.folder / name).unlink(missing_ok=True)
            measures = self._health.measures(
                size=result.depth_size,
                extrinsics=result.extrinsics,
                intrinsics=result.depth_intrinsics,
                depth_scale=result.depth_scale,
                # What the model saw, whatever calibration was given.
                field_of_view=self._predictor.cameras().pose_encoding[:, 8].astype(np.float64),
                signals=self._predictor.signals(),
            )
            write_health(result.folder, examine(measures, result.names), result.names)

    def _pictures(self) -> Iterator[_Picture | None]:
        """The rest of the source, read ahead; where it breaks off, what is done is saved."""
        try:
            yield from self._pool.map(self._prepare, self._source.loaders(self.num_taken))
        except InputError:
            if self._predictor.num_frames:
                self._save()
                warnings.warn(
                    f"{self._predictor.num_frames} frames are kept in {self._work.path}; when the reason is mended, "
                    "the same command goes on from there",
                    stacklevel=2,
                )
            raise

    def _prepare(self, load: Callable[[], SourceFrame | None]) -> _Picture | None:
        frame = load()
        if frame is None:
            return None
        image, transform = resize(frame.image, longer_edge=self._longer_edge)
        return _Picture(frame.name, frame.timestamp, image, transform, frame.focal_length)

    def _hand_on(self, results: list[FrameResult]) -> None:
        for result in results:
            name = self._names[result.index]
            depth, image = depth_file(self._work.path, name), image_file(self._work.path, name)
            self._files += [depth, image]
            self._pool.submit(self._write, depth, image, self._images.pop(result.index), result)

    def _write(self, depth: Path, image: Path, pixels: np.ndarray, result: FrameResult) -> None:
        write_picture(image, pixels)
        stored = write_depth(depth, result.depth, result.confidence)
        self.selection.see(result.index, *stored, pixels)
        with without_harm():
            self._health.see(result.index, *stored, pixels)

    def _save(self) -> None:
        started = time.monotonic()
        results, predictor = self._predictor.snapshot()
        self._hand_on(results)
        self._pool.finish()
        arrays = {f"predictor/{name}": array for name, array in predictor.items()}
        arrays |= {f"points/{name}": array for name, array in self.selection.arrays().items()}
        arrays |= {f"health/{name}": array for name, array in self._health.arrays().items()}
        arrays |= {f"images/{index}": image for index, image in self._images.items()}
        facts = {
            "source": self._source.fingerprint(self.num_taken),
            "num_taken": self.num_taken,
            "names": self._names,
            "timestamps": self._timestamps,
            "skipped": self._source.skipped,
            "focal_length": self._focal_length,
            "size": None if self._transform is None else self._transform.original_size,
            "model_size": None if self._transform is None else self._transform.size,
        }
        self._work.save(State(arrays, facts), self._files)
        self._files = []
        self._last_save = time.monotonic()
        self._saving = self._last_save - started

    def _restore(self, saved: State) -> None:
        facts = saved.facts
        self.num_taken = facts["num_taken"]
        if self._source.fingerprint(self.num_taken) != facts["source"]:
            raise InputError(
                f"{self._source.path} has changed since {self._work.path} was left unfinished: frames that were read "
                "are other ones, or are taken otherwise; pass --overwrite to start anew"
            )
        self._focal_length = facts["focal_length"]
        self._names, self._timestamps = facts["names"], facts["timestamps"]
        self._source.skipped[:] = [SkippedFrame(*each) for each in facts["skipped"]]
        if facts["size"]:
            self._transform = ResizeTransform(tuple(facts["size"]), tuple(facts["model_size"]))

        def part(prefix: str) -> dict[str, np.ndarray]:
            found = {name: array for name, array in saved.arrays.items() if name.startswith(prefix)}
            return {name.removeprefix(prefix): array for name, array in found.items()}

        self._predictor.restore(part("predictor/"))
        self.selection.restore(part("points/"))
        self._health.restore(part("health/"))
        self._images = {int(index): image for index, image in part("images/").items()}
