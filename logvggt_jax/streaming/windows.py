"""A stream of frames through the model: depth as it becomes final, poses as the refinement mode allows."""

from __future__ import annotations

import copy
import dataclasses
import functools
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import RefinementConfig, require_counts
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.model.windows import WindowState
from logvggt_jax.streaming.loops import LoopCloser, LoopSettings, frame_describer, loop_settings
from logvggt_jax.streaming.named_arrays import of_part, part_of
from logvggt_jax.streaming.offline import predict_plain
from logvggt_jax.streaming.pose_stream import Poses, PoseStream, in_one_mode, relative_change
from logvggt_jax.streaming.program import Program, abstract_variables, flops_of
from logvggt_jax.streaming.results import (
    Cameras,
    FrameResult,
    Progress,
    Signals,
    checked_frames,
    checked_masks,
    decoded_cameras,
    device_memory,
)
from logvggt_jax.streaming.rows import Rows
from logvggt_jax.types import WindowOutput

# The model is hashable and static, so that all sessions of a model share their compiled programs.


@functools.partial(jax.jit, static_argnums=0)
def _start(
    model: LogVGGT, variables: Variables, frames: jax.Array, mask: jax.Array | None, masks: jax.Array | None = None
) -> WindowState:
    return model.start(variables, frames, mask, masks)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    model: LogVGGT,
    variables: Variables,
    state: WindowState,
    frames: jax.Array,
    mask: jax.Array | None,
    masks: jax.Array | None = None,
) -> tuple[WindowState, WindowOutput, jax.Array]:
    """The step, and how far apart the two copies are of each frame [B, s] that becomes final, as a fraction of its
    camera token's norm; NaN for a frame that was in one window alone."""
    before = state.special_tokens[:, :, 0]
    state_after, output = model.step(variables, state, frames, mask, masks)
    twice = min(before.shape[1], output.camera_tokens.shape[1])
    change = relative_change(before[:, :twice], output.camera_tokens[:, :twice])
    change = jnp.where((state.step == 0)[:, None], jnp.nan, change)
    rest = output.camera_tokens.shape[1] - twice
    return state_after, output, jnp.pad(change, ((0, 0), (0, rest)), constant_values=jnp.nan)


@functools.partial(jax.jit, static_argnums=0)
def _finish(model: LogVGGT, variables: Variables, state: WindowState) -> WindowOutput:
    return model.finish(variables, state)


def window_program(
    model: LogVGGT, image_size: tuple[int, int], settings: WindowSettings, num_frames: int | None
) -> Program:
    """The step of a stream whose frames are all real."""
    plain, (_, arguments) = in_one_mode(model), _abstract_calls(model, image_size)
    flops = flops_of(plain, lambda chosen: chosen.step, *arguments)
    return Program(_step.lower(plain, *arguments), flops, model.config.windows.stride)


def window_opening(
    model: LogVGGT, image_size: tuple[int, int], settings: WindowSettings, num_frames: int | None
) -> list[jax.stages.Lowered]:
    """What a stream without masks calls before its first result, see `Method.opening`."""
    plain, (start, step) = in_one_mode(model), _abstract_calls(model, image_size)
    return [_start.lower(plain, *start), _step.lower(plain, *step)]


def _abstract_calls(model: LogVGGT, image_size: tuple[int, int]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """The arguments of `_start` and of `_step` as a session has them where all frames are real and have no masks."""
    plain, config = in_one_mode(model), model.config.windows
    variables = abstract_variables(model.config)

    def frames(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, count, *image_size, 3), jnp.uint8)

    start = (variables, frames(config.size - config.stride), None, None)
    state = jax.eval_shape(plain.start, *start)
    return start, (variables, state, frames(config.stride), None, None)


class _Frame(NamedTuple):
    """A frame [H, W, 3] and its mask bool [H, W], where it has one."""

    image: np.ndarray
    mask: np.ndarray | None


class _Flight(NamedTuple):
    """A window whose results are on their way from the device.

    Attributes:
      output: of the step; the first `valid` entries are frames.
      valid: frames that became final.
      overlap_change: [1, n] of these frames; None for the last ones, which nothing came after.
      poses: that became final with them.
    """

    output: WindowOutput
    valid: int
    overlap_change: jax.Array | None
    poses: list[Poses]


@dataclasses.dataclass(frozen=True)
class WindowSettings:
    """Settings of a stream.

    Attributes:
      provisional: give results whose pose is not final yet the pose they would have if the stream ended now.
        Costs a run of refinement and camera head over all frames so far at every window.
      ahead: windows that may be on the device when `push` returns. With 1 the device works while the caller does,
        and a window's results come with the next window; with 0 they come at once.
      first_capacity: frames that the token buffers hold at first; they double.
      loops: close loops when the sequence ends: True, or how they are looked for. No pose is final before; both places
        of a loop are predicted together in one window.
    """

    provisional: bool = False
    ahead: int = 1
    first_capacity: int = 256
    loops: LoopSettings | bool = False

    def __post_init__(self) -> None:
        require_counts(self, "first_capacity")
        require_counts(self, "ahead", least=0)


class StreamSession:
    """Feeds frames to the model one by one and hands out what has become final.

        session = StreamSession(model, variables)
        for frame in frames:                      # uint8 [H, W, 3]
            for result in session.push(frame):
                ...                               # result.depth, result.confidence
        for result in session.close():
            ...
        cameras = session.cameras()

    The numbers are those of `model.apply` on the whole sequence, in every refinement mode (beyond `LONG_SEQUENCE`
    frames that are refined at the end, those of `context=LONG_CONTEXT` where no context is set). Device memory is
    constant but for what refinement reads of every frame (two camera tokens and GCCR's keys and values, 49 kB in
    VGGT-1B's size with bfloat16, 82 kB with float32). With `refinement.period`, `context` and `max_registers` set it
    is constant, as is the time a frame; the host keeps 44 bytes a frame. The depth of a frame leaves the device as soon
    as it is final. Sessions of one model share its programs, and its parameters where these are in the compute type,
    as `load_model` gives them.

    Args:
      model: the model; `model.config.refinement` sets when poses become final.
      variables: {"params": …}.
      settings: of the stream.
      **options: fields of `WindowSettings` by name, in place of those of `settings`.
    """

    def __init__(
        self, model: LogVGGT, variables: Variables, settings: WindowSettings = WindowSettings(), **options: Any
    ) -> None:
        self._model, self._settings = model, dataclasses.replace(settings, **options)
        # Once, not at every call: cast, and brought to the device where they are numpy arrays.
        self._variables = jax.device_put(in_compute_type(variables, model.config))
        self._windows = in_one_mode(model)  # of which windows know nothing
        self._poses = PoseStream(
            model,
            self._variables,
            first_capacity=self._settings.first_capacity,
            late=(self._settings.ahead + 1) * model.config.windows.size,
        )
        self._pending: list[_Frame] = []
        self._state: WindowState | None = None
        self._flights: deque[_Flight] = deque()
        self._newest: _Frame | None = None
        self._image_size = (1, 1)  # (H, W), known with the first frame
        self._received = 0
        # When the frames came that are not handed out yet; None for those of a snapshot.
        self._arrivals: deque[float | None] = deque()
        # Pose and correction [N, 10], and the two copies' difference [N], of the frames where they are known.
        self._final = Rows(np.zeros((0, 10), np.float32))
        self._overlap = Rows(np.zeros(0, np.float32))
        self._handed_out = 0
        self._loops: LoopCloser | None = None
        if (loops := loop_settings(self._settings.loops)) is not None:
            # No more than the model has ever seen at once.
            loops = dataclasses.replace(loops, frames=min(loops.frames, max(1, model.config.windows.size // 2)))
            predict = functools.partial(predict_plain, model, self._variables)
            self._loops = LoopCloser(frame_describer(model, self._variables), predict, loops)
        self._closed_loops: Cameras | None = None
        self._closed = False

    @property
    def num_frames(self) -> int:
        """Frames handed out so far; their depth is final."""
        return self._handed_out

    @property
    def state_bytes(self) -> int:
        """See `Predictor.state_bytes`: cache and held tokens, compact tokens, and frames not yet in a window."""
        arrays = jax.tree.leaves((self._state, self._pending))
        return self._poses.filled_bytes + sum(array.nbytes for array in arrays)

    def push(
        self, frames: np.ndarray | jax.Array | Sequence[np.ndarray], masks: np.ndarray | None = None
    ) -> list[FrameResult]:
        """Takes frames and returns those that became final, oldest first.

        Args:
          frames: one frame [H, W, 3] or several [n, H, W, 3], uint8 or floating point in [0, 1]; H and W are
            multiples of the patch size and the same in every call, as is the dtype.
          masks: bool [H, W] of all these frames or [n, H, W], True for pixels that count; see `LogVGGT.apply`. A
            sequence has masks for all frames or for none.

        Raises:
          ValueError: another shape or dtype, or the session is closed.
          PredictionError: the device's memory is too small.
        """
        if self._closed:
            raise ValueError("this stream is closed: make another StreamSession for another sequence")
        before, mask_before = (None, None) if self._newest is None else self._newest
        frames = checked_frames(frames, patch_size=self._model.config.encoder.patch_size, before=before)
        masks = checked_masks(masks, frames, before=before, mask_before=mask_before)
        self._image_size = (frames.shape[1], frames.shape[2])
        results: list[FrameResult] = []
        with self._memory():
            for image, mask in zip(frames, [None] * len(frames) if masks is None else masks, strict=True):
                self._newest = _Frame(image, mask)
                self._pending.append(self._newest)
                self._received += 1
                self._arrivals.append(time.monotonic())
                if self._loops is not None:
                    self._loops.see(image, mask)
                if self._advance():
                    results += self._landed(self._settings.ahead)
        return results

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        """Ends the stream: the frames still held, oldest first. Afterwards every pose is final.

        `progress` is told how many frames are refined, of how many, where a long sequence is refined at the end.
        """
        if self._closed:
            return []
        self._closed = True
        if self._newest is None:
            return []
        with self._memory():
            if self._state is None:
                self._begin()
            if self._pending or self._poses.num_frames == 0:
                self._one_step()
            assert self._state is not None  # set by _begin
            self._take_off(_finish(self._windows, self._variables, self._state), None, progress)
            self._state = self._newest = None
            results = self._landed(0)
            if self._loops is not None:
                encodings = self._final.array[:, :9]
                cameras = decoded_cameras(encodings, self._image_size, final=len(encodings))
                self._closed_loops = self._loops.close(cameras)
            return results

    def provisional(self) -> list[FrameResult]:
        """What is known of the newest frames, which later ones may still change: those that no `push` has handed out.

        Depth and pose are those of a stream that ends here. Costs about a window, and copies of the stream's state;
        the stream goes on as if nothing had been asked.
        """
        other = copy.copy(self)
        other._loops = None  # they are closed at the end, and cost more than a window
        other._pending, other._flights, other._arrivals = self._pending[:], self._flights.copy(), self._arrivals.copy()
        other._final, other._overlap = Rows(self._final.array), Rows(self._overlap.array)
        other._state, other._poses = jax.tree.map(jnp.copy, self._state), self._poses.copy()
        known = self._poses.num_frames
        final = self._num_final if self._loops is not None else known
        return [dataclasses.replace(r, pose_is_final=r.index < final and r.pose_is_final) for r in other.close()]

    def signals(self) -> Signals:
        """How well the windows agree, frame by frame of those handed out."""
        overlap, corrections = self._overlap.array, np.full(self._handed_out, np.nan, np.float32)
        corrections[: len(self._final)] = self._final.array[: self._handed_out, 9]
        return Signals.unknown(len(overlap))._replace(overlap_change=overlap.copy(), correction=corrections)

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """See `Predictor.snapshot`: cache, held and compact tokens, poses, and frames not yet in a window."""
        with self._memory():
            results = self._landed(0)
        if self._newest is None:
            return results, {}
        arrays = of_part("tokens", self._poses.arrays())
        if self._state is not None:
            values = {field.name: getattr(self._state, field.name) for field in dataclasses.fields(self._state)}
            arrays |= of_part("state", {name: np.asarray(x) for name, x in values.items() if x is not None})
        if self._pending:
            arrays["pending"] = np.stack([frame.image for frame in self._pending])
        if self._newest.mask is not None:
            arrays["newest_mask"] = self._newest.mask
        if masks := [frame.mask for frame in self._pending if frame.mask is not None]:
            arrays["pending_masks"] = np.stack(masks)
        if self._loops is not None:
            arrays |= of_part("loops", self._loops.arrays())
        return results, {
            **arrays,
            "newest": self._newest.image,
            "counts": np.array((self._received, self._handed_out), np.int64),
            "final": self._final.array.copy(),
            "overlap": self._overlap.array.copy(),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """See `Predictor.restore`."""
        if not arrays:
            return
        self._newest = _Frame(arrays["newest"], arrays.get("newest_mask"))
        self._image_size = arrays["newest"].shape[:2]
        pending = arrays.get("pending", ())
        self._pending = list(map(_Frame, pending, arrays.get("pending_masks", [None] * len(pending))))
        self._received, self._handed_out = (int(count) for count in arrays["counts"])
        self._arrivals = deque([None] * (self._received - self._handed_out))
        self._final, self._overlap = Rows(arrays["final"]), Rows(arrays["overlap"])
        self._poses.restore(part_of(arrays, "tokens"))
        if self._loops is not None:
            self._loops.restore(part_of(arrays, "loops"))
        if fields := part_of(arrays, "state"):
            del fields["image_size"]
            self._state = WindowState(
                image_size=self._image_size, **{name: jnp.asarray(array) for name, array in fields.items()}
            )

    def cameras(self, *, provisional: bool = False) -> Cameras:
        """Cameras of the frames whose pose is final, but for loops; with `provisional` of all frames handed out."""
        if self._closed_loops is not None:
            return self._closed_loops
        encodings = self._all_encodings(provisional=provisional)
        return decoded_cameras(encodings, self._image_size, final=self._num_final)

    def cameras_with(self, refinement: RefinementConfig) -> Cameras:
        """Cameras of all frames of a closed stream, as another mode of refinement gives them.

        Windows know nothing of refinement, so that modes are compared on one run of them. A stream that closes loops
        closes them for these cameras.

        Raises:
          ValueError: the stream is not closed; it had no frames, or has not kept what that mode reads.
        """
        if not self._closed:
            raise ValueError("cameras_with is for a stream that is closed")
        encodings = self._poses.all_with(refinement)
        cameras = decoded_cameras(encodings, self._image_size, final=len(encodings))
        return cameras if self._loops is None else self._loops.close(cameras)

    @property
    def _num_final(self) -> int:
        """Poses that nothing will change."""
        return len(self._final) if self._loops is None else 0

    def _memory(self) -> AbstractContextManager[None]:
        height, width = self._image_size
        frames = self._model.config.windows.size
        return device_memory(f"a window of {frames} frames of {height} x {width} pixels", "take smaller frames")

    def _all_encodings(self, *, provisional: bool) -> np.ndarray:
        """Final pose encodings [N, 9]; with `provisional` those of all frames handed out."""
        done, final = len(self._final), self._final.array[:, :9]
        if not provisional or done >= self._handed_out:
            return final
        return np.concatenate([final, self._poses.provisional(done, self._handed_out)])

    # Dispatch: nothing here waits for the device.

    def _advance(self) -> bool:
        """Starts the work that the pending frames allow; whether a window was begun."""
        config = self._model.config.windows
        if self._state is None:
            if len(self._pending) < config.size - config.stride:
                return False
            self._begin()
        if len(self._pending) < config.stride:
            return False
        self._one_step()
        return True

    def _take(self, count: int) -> tuple[jax.Array, jax.Array | None, jax.Array | None]:
        """The next `count` pending frames [1, count, H, W, 3], which of them count where not all do (a short rest
        repeats the last), and their masks [1, count, H, W] where they have some."""
        frames, self._pending = self._pending[:count], self._pending[count:]
        real = None
        if len(frames) < count:
            assert self._newest is not None
            real = jnp.asarray((np.arange(count) < len(frames))[None])
            frames += [self._newest] * (count - len(frames))
        images, masks = zip(*frames, strict=True)
        return (
            jnp.asarray(np.stack(images)[None]),
            real,
            None if masks[0] is None else jnp.asarray(np.stack(masks)[None]),
        )

    def _begin(self) -> None:
        config = self._model.config.windows
        self._state = _start(self._windows, self._variables, *self._take(config.size - config.stride))

    def _one_step(self) -> None:
        frames = self._take(self._model.config.windows.stride)
        assert self._state is not None
        self._state, out, change = _step(self._windows, self._variables, self._state, *frames)
        self._take_off(out, change)

    def _take_off(
        self,
        output: WindowOutput,
        overlap_change: jax.Array | None,
        progress: Progress | None = None,
    ) -> None:
        """Hands on a window's tokens, with the triggers that are due, and sends for its results."""
        valid = min(output.depth.shape[1], self._received - self._poses.num_frames)
        poses = self._poses.append(output.camera_tokens, output.register_tokens, valid)
        if self._closed and self._poses.num_frames == self._received:
            poses += self._poses.finish(progress)
        # The tokens stay on the device: what is fetched is what is handed out.
        output = output.replace(camera_tokens=None, register_tokens=None, frame_mask=None)  # type: ignore[attr-defined]
        flight = _Flight(output, valid, overlap_change, poses)
        for array in jax.tree.leaves((output, overlap_change, [(each.encodings, each.corrections) for each in poses])):
            array.copy_to_host_async()
        self._flights.append(flight)

    # Results: here the host waits for what it asked for.

    def _landed(self, ahead: int) -> list[FrameResult]:
        """The results of all windows but the newest `ahead`."""
        results: list[FrameResult] = []
        while len(self._flights) > ahead:
            results += self._unloaded(self._flights.popleft())
        return results

    def _unloaded(self, flight: _Flight) -> list[FrameResult]:
        first, out = self._handed_out, flight.output
        depth, confidence = np.asarray(out.depth)[0], np.asarray(out.depth_confidence)[0]
        points, points_confidence = (
            None if x is None else np.asarray(x)[0] for x in (out.points, out.points_confidence)
        )
        for poses in flight.poses:
            found = np.column_stack([np.asarray(poses.encodings), np.asarray(poses.corrections)])
            self._final.append(found[: poses.valid])
        change = np.full(flight.valid, np.nan, np.float32)
        if flight.overlap_change is not None:
            change = np.asarray(flight.overlap_change)[0, : flight.valid]
        self._overlap.append(change)
        self._handed_out += flight.valid
        now = time.monotonic()
        encodings = self._all_encodings(provisional=self._settings.provisional)
        results = [
            FrameResult(
                index=index,
                depth=depth[offset],
                confidence=confidence[offset],
                pose_encoding=encodings[index] if index < len(encodings) else None,
                pose_is_final=index < self._num_final,
                points=None if points is None else points[offset],
                points_confidence=None if points_confidence is None else points_confidence[offset],
                latency=None if (arrival := self._arrivals.popleft()) is None else now - arrival,
                overlap_change=None if np.isnan(change[offset]) else float(change[offset]),
            )
            for offset, index in enumerate(range(first, self._handed_out))
        ]
        if self._loops is not None:
            self._loops.take(results)
        return results
