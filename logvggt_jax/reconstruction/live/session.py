"""A session that frames are pushed to as they come, and that uses the newest of them."""

from __future__ import annotations

import contextlib
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import NamedTuple

import numpy as np

from logvggt_jax.data.feeding.transforms import LONGER_EDGE, check_longer_edge
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.reconstruction.frame_writer import Picture
from logvggt_jax.reconstruction.live.newest import NewestFrames
from logvggt_jax.reconstruction.live.recording import Recording
from logvggt_jax.reconstruction.live.report import LiveReport, StageTimes
from logvggt_jax.reconstruction.masking import resized
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.watching import LiveResult
from logvggt_jax.streaming import Cameras, FrameResult, Predictor

# Used frames over which the rate is taken: at most, and at least, since frames that waited are used all at once.
_RATE_FRAMES, _FEWEST = 100, 5
# Seconds for which the window at hand is waited for when its user has lost patience.
_PATIENCE = 10.0


class _Waiting(NamedTuple):
    number: int
    timestamp: float
    image: np.ndarray
    mask: np.ndarray | None
    pushed: float  # by the monotonic clock


class LiveSession:
    """Takes frames as a camera gives them, and uses as many as the device can.

        with LiveSession(lambda: online_stream(model, variables), longer_edge=224, on_result=show) as live:
            for picture in camera:                # uint8 [H, W, 3]
                live.push(picture)
        print(live.report().table())

    `push` never waits. `capacity` frames wait for the session's own thread; when another one comes, the one that has
    waited longest is dropped, and counted. With the first frame, whose size decides them, all programs are compiled
    and run once, on a stream of its own; if frames were dropped meanwhile so is the first, so that the sequence begins
    with neighbours.

    Leaving the block uses the frames that wait, ends the stream, hands on what became final, and finishes the
    recording. What goes wrong in the thread (`on_result` included) is raised by the next `push` or at the end. After an
    error, there or in the block, the recording holds what was final, marked as incomplete, and a warning says where.

    Args:
      open_stream: gives a stream that has seen no frame, see `online_stream`.
      longer_edge: pixels to which the longer edge of the frames is resized, a multiple of 14; what the model was
        trained at.
      capacity: frames that may wait; the windows' stride is what a window takes at once.
      warm_up: frames that the stream sees before the first, so that nothing is compiled later; 0 for none.
      on_result: called with every frame whose depth is final, in order, in the session's thread; while it works, no
        frame is used.
      recording: where frames go to the disk; None for nowhere.

    Attributes:
      ready: set once the programs are there, or nothing more is used.
      unreadable: frames that whoever captures could not decode, for the report.
      complete: what a recording says of itself: False where the camera was lost.
      signal: name of the signal that ended the sequence; None where none did.
      reconstruction: what the recording has become, after an error too; None before the end, or without any.
    """

    def __init__(
        self,
        open_stream: Callable[[], Predictor],
        *,
        longer_edge: int = LONGER_EDGE,
        capacity: int = 2,
        warm_up: int = 8,
        on_result: Callable[[LiveResult], object] | None = None,
        recording: Recording | None = None,
    ) -> None:
        check_longer_edge(longer_edge)
        if capacity < 1:
            raise InputError(f"capacity must be at least 1 frame, got {capacity}")
        self.ready = threading.Event()
        self._open_stream, self._longer_edge, self._warm_up = open_stream, longer_edge, warm_up
        self._on_result, self._recording = on_result, recording
        self.unreadable, self.complete = 0, True
        self.signal: str | None = None
        self.reconstruction: Reconstruction | None = None
        self.times = StageTimes()
        self._capacity = capacity
        self._queue: NewestFrames[_Waiting] = NewestFrames(capacity)
        self._size: tuple[int, ...] | None = None
        self._masked = False
        self._began = time.monotonic()
        self._used_at: deque[float] = deque(maxlen=_RATE_FRAMES)
        # Frames in the stream that are not handed on yet, by position among those used.
        self._pictures: dict[int, tuple[Picture, float]] = {}
        self._used = self._finished = 0
        self._stream: Predictor | None = None
        self._failure: BaseException | None = None
        self._stack = contextlib.ExitStack()
        # A thread that waits for the device must not keep a process alive that was told twice to end.
        self._thread = threading.Thread(target=self._run, name="live session", daemon=True)

    def __enter__(self) -> LiveSession:
        if self._recording is not None:
            self._stack.enter_context(self._recording)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            try:
                self._queue.close(drop=kind is not None)
                self._thread.join()
                if kind is not None:
                    self._rescue()
                    return
                if self._failure is not None:
                    raise self._failure
                if self._recording is not None and self._stream is not None:
                    self.reconstruction = self._recording.finish(self._stream, complete=self.complete)
            except BaseException:
                if kind is None:
                    self._rescue()
                raise

    def _rescue(self) -> None:
        """Makes a result of what was final when an error came; what goes wrong with that must not hide the error."""
        if self._recording is None or self._stream is None:
            return
        self._queue.close(drop=True)
        self._thread.join(_PATIENCE)
        if self._thread.is_alive():
            warnings.warn("the recording is lost: the device does not answer", stacklevel=3)
            return
        try:
            self.reconstruction = self._recording.rescue(self._stream)
        except Exception as error:
            warnings.warn(f"the recording is lost, too: {one_line(error)}", stacklevel=3)
        else:
            if self.reconstruction is not None:
                kept = f"{self.reconstruction.num_frames} frames that were final are kept"
                warnings.warn(f"{kept} in {self.reconstruction.folder}", stacklevel=3)

    @property
    def failed(self) -> bool:
        """Whether something went wrong in the session's thread; `push` and leaving the block raise it."""
        return self._failure is not None

    @property
    def rule(self) -> str:
        """What becomes of frames that come too fast, in one line."""
        return f"up to {self._capacity} frames wait; a newer one drops the one that has waited longest"

    def push(self, image: np.ndarray, timestamp: float | None = None, mask: np.ndarray | None = None) -> None:
        """Hands over the newest frame; returns at once.

        Args:
          image: [H, W, 3] uint8 RGB, of one size in all calls; it must not be changed afterwards.
          timestamp: seconds, increasing; None for those since the session was made.
          mask: [H, W] bool, True for pixels that count; what else the frame shows has no influence, depth or points.
            All frames have one, or none has; it must not be changed afterwards either.

        Raises:
          InputError: another shape, size or type; a mask for some frames alone.
          ValueError: the session was left.
          Exception: whatever went wrong in the session's thread.
        """
        if self._failure is not None:
            raise self._failure
        if not self._thread.is_alive():
            raise ValueError("this live session has ended, or was not entered: make another one")
        now = time.monotonic()
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"a frame must be uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
        if self._size is not None and self._size != image.shape:
            before, size = (f"{width} x {height}" for height, width, _ in (self._size, image.shape))
            raise InputError(f"the frames were {before} pixels large and now are {size}: all need one size")
        if mask is not None and (mask.dtype != np.bool_ or mask.shape != image.shape[:2]):
            raise InputError(f"a mask must be bool {list(image.shape[:2])}, got {mask.dtype} {list(mask.shape)}")
        if self._size is not None and self._masked != (mask is not None):
            raise InputError("a sequence has masks for all frames or for none")
        self._size, self._masked = image.shape, mask is not None
        number = self._queue.counts.received
        self._queue.put(_Waiting(number, now - self._began if timestamp is None else timestamp, image, mask, now))

    def report(self) -> LiveReport:
        """How the session has kept up so far."""
        counts, used_at = self._queue.counts, list(self._used_at)
        span = used_at[-1] - used_at[0] if len(used_at) >= _FEWEST else 0.0
        return LiveReport(
            received=counts.received,
            used=counts.taken,
            dropped=counts.dropped,
            waiting=counts.waiting,
            unreadable=self.unreadable,
            finished=self._finished,
            fps=(len(used_at) - 1) / span if span > 0 else None,
            latencies=self.times.latencies(),
        )

    def cameras(self) -> Cameras | None:
        """Cameras of the frames that were used, once the session was left; None where there was none."""
        return None if self._stream is None else self._stream.cameras()

    # In the session's thread.

    def _run(self) -> None:
        try:
            self._use_frames()
        except BaseException as error:
            self._failure = error
            self._queue.close(drop=True)
        finally:
            self.ready.set()

    def _use_frames(self) -> None:
        while (frame := self._queue.take()) is not None:
            if self._stream is None and not self._prepared(frame):
                continue
            taken = time.monotonic()
            self.times.add("wait", taken - frame.pushed)
            image, mask, transform = resized(frame.image, frame.mask, longer_edge=self._longer_edge)
            at_size = time.monotonic()
            self.times.add("resize", at_size - taken)
            original = frame.image if self._recording is not None and self._recording.keeps_originals else None
            name = f"frame-{frame.number:06d}"
            picture = Picture(name, frame.timestamp, image, transform, mask=mask, original=original)
            self._pictures[self._used] = picture, frame.pushed
            self._used += 1
            self._used_at.append(taken)
            if self._recording is not None:
                self._recording.add(picture)
            assert self._stream is not None
            results = self._stream.push(image, mask)
            if results:  # or else no window was run
                self.times.add("device", time.monotonic() - at_size)
                self._hand_on(results)
        if self._stream is not None:
            self._hand_on(self._stream.close())

    def _prepared(self, first: _Waiting) -> bool:
        """Opens the stream, warm; whether the first frame is used, or counts as dropped as those after it were."""
        dropped = self._queue.counts.dropped
        if self._recording is not None:
            height, width, _ = first.image.shape
            self._recording.check((height, width))
        if self._warm_up:
            image, mask, _ = resized(first.image, first.mask, longer_edge=self._longer_edge)
            stream = self._open_stream()
            for _ in range(self._warm_up):
                stream.push(image, mask)
            stream.close()
        self._stream = self._open_stream()
        self.ready.set()
        if self._queue.counts.dropped == dropped:
            return True
        self._queue.untake()
        return False

    def _hand_on(self, results: list[FrameResult]) -> None:
        began = time.monotonic()
        if self._recording is not None:
            self._recording.write(results)
        for result in results:
            picture, pushed = self._pictures.pop(result.index)
            if self._on_result is not None:
                size = picture.transform.original_size
                self._on_result(LiveResult(picture.name, picture.timestamp, picture.image, size, result))
            self._finished += 1
            self.times.add("final", time.monotonic() - pushed)
        if results:
            self.times.add("result", time.monotonic() - began)
