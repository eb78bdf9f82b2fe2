"""A live session's result folder, the same as `reconstruct` makes."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from logvggt_jax.errors import InputError
from logvggt_jax.files import user_path
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.finishing import finish
from logvggt_jax.reconstruction.frame_pool import FramePool
from logvggt_jax.reconstruction.frame_writer import FrameWriter, Picture
from logvggt_jax.reconstruction.points.cloud_file import VERTEX
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.points.selection import PointSelection
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.work_folder import WorkFolder
from logvggt_jax.streaming import FrameResult, Predictor

# Bytes that are kept free for what follows an error: cameras, trajectory and some points.
_RESERVE = 16_000_000


class Recording:
    """Where a live session's frames go to the disk as they become final.

    The work lies in `<output>.partial` until the session ends. What a camera has shown cannot be read again: a
    recording is never taken up, and when an error ends it, what was final by then becomes the result. So that this can
    be written to a full disk, 16 MB of it are taken up from the beginning. A `LiveSession` enters and leaves it.

    Args:
      output: folder to make.
      point_filter: which pixels become points.
      calibration: intrinsics that are known; None takes those that the model predicts, frame by frame.
      keep_originals: keep the frames that were used at their own size, too, for exports; a camera shows nothing twice.
      num_previews: pictures of frames beside their depth, evenly over the sequence.
      overwrite: replace an earlier result.
      workers: threads that write; None for one a core, at most eight.

    Attributes:
      keeps_originals: whether frames are to be added with what the camera gave.
    """

    def __init__(
        self,
        output: str | Path,
        *,
        point_filter: PointFilter | None = None,
        calibration: Calibration | None = None,
        keep_originals: bool = False,
        num_previews: int = 8,
        overwrite: bool = False,
        workers: int | None = None,
    ) -> None:
        if num_previews < 0:
            raise InputError(f"num_previews must not be negative, got {num_previews}")
        self._target = user_path(output, resolved=True)
        self._filter, self._calibration = point_filter or PointFilter(), calibration or Calibration()
        self.keeps_originals = keep_originals
        self._num_previews, self._overwrite, self._workers = num_previews, overwrite, workers
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Recording:
        """Makes the folder. Raises OutputExists, or InputError where another run is at work there."""
        self._work = WorkFolder(self._target, {"source": "live"}, overwrite=self._overwrite)
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._work)
            self._pool = stack.enter_context(FramePool(self._workers))
            self._selection = PointSelection(self._filter, None)
            self._frames = FrameWriter(self._work.path, self._pool, self._selection)
            self._reserve = self._work.reserve(_RESERVE)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Lets go of the folder; without `finish` or `rescue` nothing of it is left."""
        self._stack.__exit__(kind, error, trace)

    def check(self, size: tuple[int, int]) -> None:
        """InputError where the calibration is none of frames of `size` (H, W), which those to come have."""
        self._calibration.check(size)

    def add(self, picture: Picture) -> None:
        """The next frame, which goes to the method now."""
        self._frames.add(picture)

    def write(self, results: Sequence[FrameResult]) -> None:
        """Has frames written whose depth is final; waits while too many are."""
        self._frames.write(results)

    def finish(self, stream: Predictor, *, complete: bool) -> Reconstruction | None:
        """Puts the result in its place, once all frames were written; None where there was no frame.

        Args:
          stream: that the frames went through, closed.
          complete: whether the session ended because somebody wanted it to.
        """
        if not self._frames.names:
            return None
        self._pool.finish()
        self._frames.write_cameras(stream.cameras(), self._calibration, complete=complete)
        result = Reconstruction.with_cameras_of(self._work.path)
        self._frames.write_health(result, stream)
        return self._finished(result, self._selection, num_previews=self._num_previews)

    def rescue(self, stream: Predictor) -> Reconstruction | None:
        """Puts what was final in the result's place after an error, marked as incomplete; None where nothing was.

        It has no previews and no word on its health, and on a full disk fewer points. Nothing may be at work on the
        recording or the stream any more.
        """
        self._pool.settle()
        if not len(stream.cameras().is_final):
            with contextlib.suppress(Exception):  # the poses of some streams are final when they are closed
                stream.close()
        cameras = stream.cameras()
        count = self._frames.keep_written(len(cameras.is_final))
        if not count:
            return None
        self._reserve.unlink(missing_ok=True)
        self._frames.write_cameras(cameras.first(count), self._calibration, complete=False)
        result = Reconstruction.with_cameras_of(self._work.path)
        room = shutil.disk_usage(self._work.path).free // 2 // VERTEX.itemsize
        return self._finished(result, self._selection.first(count, most=room), num_previews=0)

    def _finished(self, result: Reconstruction, selection: PointSelection, *, num_previews: int) -> Reconstruction:
        finish(result, selection, self._pool, num_previews=num_previews, advance=lambda: None)
        # Whatever ended it: nothing can go on from there.
        self._work.commit(complete=True)
        return dataclasses.replace(result, folder=self._target)
