"""A sequence on its way through a method: frames in, depth to disk, and the state saved now and then."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

from logvggt_jax.compile import out_of_device_memory
from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.errors import InputError, one_line, too_little_memory
from logvggt_jax.interruption import Interrupted, StopRequest
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.frame_writer import FrameWriter, Picture
from logvggt_jax.reconstruction.masking import resized
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.saved_source import check_frames, check_source, source_facts
from logvggt_jax.reconstruction.sources import SkippedFrame, Source, SourceFrame
from logvggt_jax.reconstruction.sources.record import record_source
from logvggt_jax.reconstruction.watching import Watcher
from logvggt_jax.reconstruction.work_folder import WorkFolder
from logvggt_jax.streaming import FrameResult, Predictor, Progress
from logvggt_jax.streaming.pose_stream import LONG_SEQUENCE
from logvggt_jax.streaming.state_file import State

# Saving takes at most this share of the time.
_SAVING = 0.05
# Likewise poses that are asked for before they are final, for those who watch.
_LOOKING = 0.05
# Seconds.
_BETWEEN_LOOKS = 1.0


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
      watcher: is shown every frame whose depth is final, and poses as they are known; None for nobody.

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
        watcher: Watcher | None = None,
    ) -> None:
        self._source, self._work, self._predictor, self._pool = source, work, predictor, pool
        self.selection, self._longer_edge = selection, longer_edge
        self._save_seconds = save_seconds
        self._last_save, self._saving = time.monotonic(), 0.0
        self._watcher = watcher
        # When poses that are not final may be asked for again; None once they are not worth it, or cannot be had.
        self._next_look: float | None = 0.0
        self._look_took = 0.0
        self._frames = FrameWriter(work.path, pool, selection)
        # Written since the last save.
        self._files: list[Path] = []
        self.num_taken = 0
        # Frames of the method that the saved state holds.
        self._num_saved = 0
        if (saved := work.saved()) is not None:
            self._restore(saved)
        work.go_on()

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
                self._frames.add(picture)
                mask = () if picture.mask is None else (picture.mask,)
                self._hand_on(self._predictor.push(picture.image, *mask))
            advance()
            if stop.reason:
                break
            if time.monotonic() - self._last_save > max(self._save_seconds, self._saving / _SAVING):
                self._save()
        if stop.reason and not self._frames.names:
            raise Interrupted(stop.reason, "no frame had been read yet")
        if stop.reason:
            self._save()
        if stop.reason not in (None, "SIGINT"):
            kept = f"{self._predictor.num_frames} frames are kept in {self._work.path}"
            raise Interrupted(stop.reason, f"{kept}; the same command goes on from there")
        self._hand_on(self._predictor.close(refined))
        self._pool.finish()
        if not self._frames.names:
            raise InputError(f"{self._source.path} gave no frame")
        return stop.reason is None

    def write_cameras(self, calibration: Calibration, *, complete: bool) -> None:
        """Writes the cameras of all frames, as far as they are known by the calibration; all numbers are finite."""
        self._frames.write_cameras(
            self._predictor.cameras(),
            calibration,
            complete=complete,
            skipped=self._source.skipped,
            source=record_source(self._source, self.num_taken),
            timed=self._source.is_timed,
        )

    def write_health(self, result: Reconstruction) -> None:
        """Writes what is to be said of the quality of `result`, whose cameras are written; never raises."""
        self._frames.write_health(result, self._predictor)

    def _pictures(self) -> Iterator[Picture | None]:
        """The rest of the source, read ahead; where it breaks off, what is done is saved."""
        try:
            yield from self._pool.map(self._prepare, self._source.loaders(self.num_taken))
        except (InputError, MemoryError) as error:
            if self._predictor.num_frames:
                with contextlib.suppress(MemoryError):  # what was saved before is kept then
                    self._save()
            if self._num_saved:
                warnings.warn(
                    f"{self._num_saved} frames are kept in {self._work.path}; when the reason is mended, the same "
                    "command goes on from there",
                    stacklevel=2,
                )
            if isinstance(error, MemoryError):
                raise too_little_memory(self._source.name, self._source.image_size, error) from error
            raise

    def _prepare(self, load: Callable[[], SourceFrame | None]) -> Picture | None:
        frame = load()
        if frame is None:
            return None
        image, mask, transform = resized(frame.image, frame.mask, longer_edge=self._longer_edge)
        return Picture(frame.name, frame.timestamp, image, transform, frame.focal_length, mask)

    def _hand_on(self, results: list[FrameResult]) -> None:
        if self._watcher is not None:
            for result in results:
                self._watcher.add(self._frames.live_result(result))
            if any(not result.pose_is_final for result in results):
                self._show_poses(self._watcher)
        self._files += self._frames.write(results)

    def _show_poses(self, watcher: Watcher) -> None:
        """Shows poses that are not final, seldom enough to cost a share of the time alone; too little memory ends
        that alone."""
        began = time.monotonic()
        if self._next_look is None or began < self._next_look:
            return
        try:
            watcher.place(self._predictor.cameras(provisional=True).pose_encoding)
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            if not (isinstance(error, MemoryError) or out_of_device_memory(error)):
                raise
            warnings.warn(f"poses are shown at the end alone, the run goes on: {one_line(error)}", stacklevel=2)
            self._next_look = None
            return
        now = time.monotonic()
        # Of two looks the quicker one, since now and then a program is compiled for longer buffers.
        pause = min(self._look_took, now - began) / _LOOKING
        self._look_took = now - began
        # Beyond, they are not refined at once any more.
        self._next_look = None if self._predictor.num_frames > LONG_SEQUENCE else now + max(pause, _BETWEEN_LOOKS)

    def _save(self) -> None:
        started = time.monotonic()
        results, predictor = self._predictor.snapshot()
        self._hand_on(results)
        self._pool.finish()
        arrays = {f"predictor/{name}": array for name, array in predictor.items()}
        arrays |= {f"points/{name}": array for name, array in self.selection.arrays().items()}
        arrays |= {f"health/{name}": array for name, array in self._frames.health.arrays().items()}
        arrays |= {f"images/{index}": image for index, image in self._frames.images.items()}
        facts = {
            **source_facts(self._source, self.num_taken, self._frames.names),
            "names": self._frames.names,
            "timestamps": self._frames.timestamps,
            "masked": self._frames.masked,
            "skipped": self._source.skipped,
            "focal_lengths": self._frames.focal_lengths,
            "size": None if self._frames.transform is None else self._frames.transform.original_size,
            "model_size": None if self._frames.transform is None else self._frames.transform.size,
        }
        self._work.save(State(arrays, facts), self._files)
        self._num_saved = self._predictor.num_frames
        self._files = []
        self._last_save = time.monotonic()
        self._saving = self._last_save - started

    def _restore(self, saved: State) -> None:
        facts = saved.facts
        self.num_taken = facts["num_taken"]
        check_source(self._source, facts, self._work.found_at)
        check_frames(saved, self._work.path)
        self._frames.masked = facts.get("masked", [])  # of earlier versions
        self._frames.focal_lengths = facts.get("focal_lengths", [])
        self._frames.names, self._frames.timestamps = facts["names"], facts["timestamps"]
        self._source.skipped[:] = [SkippedFrame(*each) for each in facts["skipped"]]
        if facts["size"]:
            self._frames.transform = ResizeTransform(tuple(facts["size"]), tuple(facts["model_size"]))

        def part(prefix: str) -> dict[str, np.ndarray]:
            found = {name: array for name, array in saved.arrays.items() if name.startswith(prefix)}
            return {name.removeprefix(prefix): array for name, array in found.items()}

        self._predictor.restore(part("predictor/"))
        self._num_saved = self._predictor.num_frames
        self.selection.restore(part("points/"))
        self._frames.health.restore(part("health/"))
        self._frames.images = {int(index): image for index, image in part("images/").items()}
