"""A stream of frames through the model: depth as it becomes final, poses as the refinement mode allows."""

from __future__ import annotations

import dataclasses
import functools
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import RefinementConfig, require_counts
from logvggt_jax.model.gccr import RegisterKeys
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.model.refinement import Span
from logvggt_jax.model.windows import WindowState
from logvggt_jax.streaming.loops import LoopCloser, LoopSettings, frame_describer, loop_settings
from logvggt_jax.streaming.offline import predict_plain
from logvggt_jax.streaming.program import Program, abstract_variables, flops_of
from logvggt_jax.streaming.results import Cameras, FrameResult, checked_frames, decoded_cameras, device_memory
from logvggt_jax.streaming.token_store import TokenStore
from logvggt_jax.types import WindowOutput

# The model is hashable and static, so that all sessions of a model share their compiled programs.


@functools.partial(jax.jit, static_argnums=0)
def _start(model: LogVGGT, variables: Variables, frames: jax.Array, mask: jax.Array | None) -> WindowState:
    return model.start(variables, frames, mask)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    model: LogVGGT, variables: Variables, state: WindowState, frames: jax.Array, mask: jax.Array | None
) -> tuple[WindowState, WindowOutput]:
    return model.step(variables, state, frames, mask)


@functools.partial(jax.jit, static_argnums=0)
def _finish(model: LogVGGT, variables: Variables, state: WindowState) -> WindowOutput:
    return model.finish(variables, state)


@functools.partial(jax.jit, static_argnums=0)
def _project(model: LogVGGT, variables: Variables, register_tokens: jax.Array) -> RegisterKeys:
    return model.refinement.project_registers(variables, register_tokens)


@functools.partial(jax.jit, static_argnums=0, static_argnames="size")
def _fire(
    model: LogVGGT,
    variables: Variables,
    camera_tokens: jax.Array,
    registers: RegisterKeys | None,
    refined: jax.Array,
    span: Span,
    *,
    size: int,
) -> tuple[jax.Array, jax.Array]:
    """One trigger: refined tokens with the span's frames added, and pose encodings [size, 9] from its start."""
    refined, encodings = model.refinement.fire(variables, camera_tokens, registers, refined, span, size=size)
    return refined, encodings[0, :, -1]


@functools.partial(jax.jit, static_argnums=0)
def _fire_all(
    model: LogVGGT, variables: Variables, camera_tokens: jax.Array, registers: RegisterKeys | None, count: jax.Array
) -> jax.Array:
    return model.refinement.fire_all(variables, camera_tokens, registers, count[None])[0, :, -1]


def window_program(
    model: LogVGGT, image_size: tuple[int, int], settings: WindowSettings, num_frames: int | None
) -> Program:
    """The step of a stream whose frames are all real."""
    plain, config = _without_refinement(model), model.config.windows
    variables = abstract_variables(model.config)

    def frames(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, count, *image_size, 3), jnp.uint8)

    state = jax.eval_shape(lambda v, f: plain.start(v, f, None), variables, frames(config.size - config.stride))
    arguments = (variables, state, frames(config.stride))
    flops = flops_of(plain, lambda chosen: lambda v, s, f: chosen.step(v, s, f, None), *arguments)
    return Program(_step.lower(plain, *arguments, None), flops, config.stride)


def _without_refinement(model: LogVGGT) -> LogVGGT:
    """The model with one mode of refinement for all, so that sessions which differ in it share their programs: windows
    know nothing of it."""
    plain = dataclasses.replace(model.config.refinement, enabled=True, period=None, context=None)
    return LogVGGT(dataclasses.replace(model.config, refinement=plain))


class _Flight(NamedTuple):
    """A window whose results are on their way from the device.

    Attributes:
      output: of the step; the first `valid` entries are frames.
      valid: frames that became final.
      encodings: poses that became final with them, [n, 9] each, the first so many of which count.
    """

    output: WindowOutput
    valid: int
    encodings: list[tuple[jax.Array, int]]


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

    The numbers are those of `model.apply` on the whole sequence, in every refinement mode. Device memory is
    constant but for what refinement reads of every frame (two camera tokens and GCCR's keys and values, 49 kB in
    VGGT-1B's size with bfloat16, 82 kB with float32); the depth of a frame leaves the device as soon as it is final.

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
        self._windows = _without_refinement(model)
        self._store = TokenStore(first_capacity=self._settings.first_capacity)
        self._pending: list[np.ndarray] = []
        self._state: WindowState | None = None
        self._flights: deque[_Flight] = deque()
        self._newest: np.ndarray | None = None
        self._image_size = (1, 1)  # (H, W), known with the first frame
        self._received = 0
        # Frames whose pose some trigger has taken, whether it is here or still on its way.
        self._refined = 0
        self._encodings = np.zeros((0, 9), np.float32)
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

    def push(self, frames: np.ndarray | jax.Array | Sequence[np.ndarray]) -> list[FrameResult]:
        """Takes frames and returns those that became final, oldest first.

        Args:
          frames: one frame [H, W, 3] or several [n, H, W, 3], uint8 or floating point in [0, 1]; H and W are
            multiples of the patch size and the same in every call, as is the dtype.

        Raises:
          ValueError: another shape or dtype, or the session is closed.
          PredictionError: the device's memory is too small.
        """
        if self._closed:
            raise ValueError("this stream is closed: make another StreamSession for another sequence")
        frames = checked_frames(frames, patch_size=self._model.config.encoder.patch_size, before=self._newest)
        self._image_size = (frames.shape[1], frames.shape[2])
        results: list[FrameResult] = []
        with self._memory():
            for frame in frames:
                self._pending.append(frame)
                self._newest = frame
                self._received += 1
                if self._loops is not None:
                    self._loops.see(frame)
                if self._advance():
                    results += self._landed(self._settings.ahead)
        return results

    def close(self) -> list[FrameResult]:
        """Ends the stream: the frames still held, oldest first. Afterwards every pose is final."""
        if self._closed:
            return []
        self._closed = True
        if self._newest is None:
            return []
        with self._memory():
            if self._state is None:
                self._begin()
            if self._pending or self._store.count == 0:
                self._one_step()
            assert self._state is not None  # set by _begin
            self._take_off(_finish(self._windows, self._variables, self._state))
            self._state = self._newest = None
            results = self._landed(0)
            if self._loops is not None:
                cameras = decoded_cameras(self._encodings, self._image_size, final=len(self._encodings))
                self._closed_loops = self._loops.close(cameras)
            return results

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """See `Predictor.snapshot`: cache, held and compact tokens, poses, and frames not yet in a window."""
        with self._memory():
            results = self._landed(0)
        if self._newest is None:
            return results, {}
        arrays = {f"tokens/{name}": array for name, array in self._store.arrays().items()} if self._store.count else {}
        if self._state is not None:
            fields = dataclasses.fields(self._state)
            arrays |= {f"state/{field.name}": np.asarray(getattr(self._state, field.name)) for field in fields}
        if self._pending:
            arrays["pending"] = np.stack(self._pending)
        if self._loops is not None:
            arrays |= {f"loops/{name}": array for name, array in self._loops.arrays().items()}
        counts = (self._received, self._refined, self._handed_out)
        return results, {
            **arrays,
            "newest": self._newest,
            "counts": np.array(counts, np.int64),
            "encodings": self._encodings,
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """See `Predictor.restore`."""
        if not arrays:
            return
        self._newest = arrays["newest"]
        self._image_size = (self._newest.shape[0], self._newest.shape[1])
        self._pending = list(arrays.get("pending", ()))
        self._received, self._refined, self._handed_out = (int(count) for count in arrays["counts"])
        self._encodings = arrays["encodings"]
        if self._loops is not None:
            self._loops.restore({name.removeprefix("loops/"): x for name, x in arrays.items() if name[:6] == "loops/"})
        if tokens := {name.removeprefix("tokens/"): x for name, x in arrays.items() if name.startswith("tokens/")}:
            self._store.restore(tokens)
        if fields := {name.removeprefix("state/"): x for name, x in arrays.items() if name.startswith("state/")}:
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
          ValueError: the stream is not closed; it ran without refinement, so that it has kept no registers.
        """
        store = self._store
        if not self._closed or store.camera is None:
            raise ValueError("cameras_with is for a stream that has had frames and is closed")
        if refinement.enabled and store.registers is None:
            raise ValueError("this stream ran with refinement off and kept no registers; open it with refinement on")
        model = LogVGGT(dataclasses.replace(self._model.config, refinement=refinement))
        registers = store.registers if refinement.enabled else None
        encodings = _fire_all(model, self._variables, store.camera, registers, jnp.int32(store.count))
        cameras = decoded_cameras(np.asarray(encodings)[: store.count], self._image_size, final=store.count)
        return cameras if self._loops is None else self._loops.close(cameras)

    @property
    def _num_final(self) -> int:
        """Poses that nothing will change."""
        return len(self._encodings) if self._loops is None else 0

    def _memory(self) -> AbstractContextManager[None]:
        height, width = self._image_size
        frames = self._model.config.windows.size
        return device_memory(f"a window of {frames} frames of {height} x {width} pixels", "take smaller frames")

    def _all_encodings(self, *, provisional: bool) -> np.ndarray:
        """Final pose encodings [N, 9]; with `provisional` those of all frames handed out."""
        done = len(self._encodings)
        if not provisional or done >= self._handed_out:
            return self._encodings
        _, encodings = self._trigger(done, self._handed_out)
        return np.concatenate([self._encodings, np.asarray(encodings)[: self._handed_out - done]])

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

    def _take(self, count: int) -> tuple[jax.Array, jax.Array | None]:
        """The next `count` pending frames [1, count, H, W, 3]; a short rest repeats the last and comes with a mask."""
        frames, self._pending = self._pending[:count], self._pending[count:]
        if len(frames) == count:
            return jnp.asarray(np.stack(frames)[None]), None
        assert self._newest is not None
        mask = np.arange(count) < len(frames)
        frames += [self._newest] * (count - len(frames))
        return jnp.asarray(np.stack(frames)[None]), jnp.asarray(mask[None])

    def _begin(self) -> None:
        config = self._model.config.windows
        self._state = _start(self._windows, self._variables, *self._take(config.size - config.stride))

    def _one_step(self) -> None:
        frames, mask = self._take(self._model.config.windows.stride)
        assert self._state is not None
        self._state, out = _step(self._windows, self._variables, self._state, frames, mask)
        self._take_off(out)

    def _take_off(self, output: WindowOutput) -> None:
        """Stores a window's tokens, fires the triggers that are due, and sends for its results."""
        valid = min(output.depth.shape[1], self._received - self._store.count)
        registers = None
        if self._model.config.refinement.enabled:
            registers = _project(self._windows, self._variables, output.register_tokens)
        self._store.append(output.camera_tokens, registers, valid)
        # The tokens stay on the device: what is fetched is what is handed out.
        output = output.replace(camera_tokens=None, register_tokens=None, frame_mask=None)  # type: ignore[attr-defined]
        flight = _Flight(output, valid, self._due_poses(last=self._store.count == self._received and self._closed))
        for array in jax.tree.leaves((flight.output, [encodings for encodings, _ in flight.encodings])):
            array.copy_to_host_async()
        self._flights.append(flight)

    def _due_poses(self, *, last: bool) -> list[tuple[jax.Array, int]]:
        """Fires the triggers that are due; pose encodings and how many of them count."""
        period, poses = self._model.config.refinement.period, []
        while self._refined < (count := self._store.count):
            due = period is not None and count >= self._refined + period
            if not due and not last:
                break
            stop = self._refined + period if due and period is not None else count
            if period is None:
                # What reads all frames runs once: at their number, not at the buffers' size.
                self._store.trim()
            self._store.refined, encodings = self._trigger(self._refined, stop)
            poses.append((encodings, stop - self._refined))
            self._refined = stop
        return poses

    def _trigger(self, start: int, stop: int) -> tuple[jax.Array, jax.Array]:
        """Refined tokens and pose encodings of a trigger that takes the frames [start, stop)."""
        store, period = self._store, self._model.config.refinement.period
        if period is not None:
            store.reserve(start + period)
        assert store.camera is not None and store.refined is not None
        return _fire(
            self._model,
            self._variables,
            store.camera,
            store.registers,
            store.refined,
            Span(jnp.int32(start), jnp.int32(stop), jnp.full(1, stop, jnp.int32)),
            size=store.capacity if period is None else period,
        )

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
        arrived = [np.asarray(encodings)[:count] for encodings, count in flight.encodings]
        self._encodings = np.concatenate([self._encodings, *arrived])
        self._handed_out += flight.valid
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
            )
            for offset, index in enumerate(range(first, self._handed_out))
        ]
        if self._loops is not None:
            self._loops.take(results)
        return results
