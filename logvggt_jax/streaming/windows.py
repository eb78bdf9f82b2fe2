"""A stream of frames through the model: depth as it becomes final, poses as the refinement mode allows."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.geometry import decode_poses
from logvggt_jax.model.gccr import RegisterKeys
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.refinement import trigger_range
from logvggt_jax.model.windows import WindowState
from logvggt_jax.streaming.token_store import TokenStore
from logvggt_jax.types import WindowOutput


@dataclasses.dataclass(frozen=True)
class FrameResult:
    """One frame whose depth is final, numpy arrays.

    Attributes:
      index: position in the stream, from 0.
      depth: [H, W] float32, z-depth in the unit of the poses' translations.
      confidence: [H, W] float32, at least 1.
      pose_encoding: [9] float32, see `logvggt_jax.geometry.decode_poses`; None while the frame has no pose.
      pose_is_final: whether `pose_encoding` stays as it is.
      points: [H, W, 3] float32 in the first camera's frame; None without point head.
      points_confidence: [H, W] float32; None without point head.
    """

    index: int
    depth: np.ndarray
    confidence: np.ndarray
    pose_encoding: np.ndarray | None
    pose_is_final: bool
    points: np.ndarray | None
    points_confidence: np.ndarray | None


class Cameras(NamedTuple):
    """Cameras of the first N frames of a stream, numpy arrays.

    Attributes:
      pose_encoding: [N, 9] float32.
      extrinsics: [N, 3, 4] float32, world-to-camera (OpenCV); the world is the first camera's frame.
      intrinsics: [N, 3, 3] float32, pixels of the model's input.
      is_final: bool [N], False where later frames may still move the pose.
    """

    pose_encoding: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    is_final: np.ndarray


def checked_frames(
    frames: np.ndarray | jax.Array | Sequence[np.ndarray], *, patch_size: int, before: np.ndarray | None
) -> np.ndarray:
    """Frames [n, H, W, 3] of one frame [H, W, 3] or several, fit for the model.

    Args:
      frames: uint8 or floating point in [0, 1].
      patch_size: H and W must be multiples of it.
      before: an earlier frame [H, W, 3] of the same stream, whose shape and dtype these must have.

    Raises:
      ValueError: another shape or dtype.
    """
    frames = np.asarray(frames)
    frames = frames[None] if frames.ndim == 3 else frames
    shape = frames.shape
    if len(shape) != 4 or shape[-1] != 3 or 0 in shape:
        raise ValueError(f"frames must have shape [n, H, W, 3] or [H, W, 3], got {shape}")
    if shape[1] % patch_size or shape[2] % patch_size:
        raise ValueError(
            f"frames of {shape[1]} x {shape[2]} pixels: height and width must be multiples of {patch_size}; "
            "logvggt_jax.preprocess resizes frames of any size"
        )
    if frames.dtype != np.uint8 and not np.issubdtype(frames.dtype, np.floating):
        raise ValueError(f"frames must be uint8 or floating point in [0, 1], got dtype {frames.dtype}")
    if before is not None and (before.shape != shape[1:] or before.dtype != frames.dtype):
        raise ValueError(
            f"frames of a stream must be alike: {before.dtype} {before.shape} before, now {frames.dtype} {shape[1:]}"
        )
    return frames


# The model is hashable and static, so that all sessions of a model share their compiled programs.


@functools.partial(jax.jit, static_argnums=0)
def _start(model: LogVGGT, variables: Variables, frames: jax.Array, mask: jax.Array) -> WindowState:
    return model.start(variables, frames, mask)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    model: LogVGGT, variables: Variables, state: WindowState, frames: jax.Array, mask: jax.Array
) -> tuple[WindowState, WindowOutput]:
    return model.step(variables, state, frames, mask)


@functools.partial(jax.jit, static_argnums=0)
def _finish(model: LogVGGT, variables: Variables, state: WindowState) -> WindowOutput:
    return model.finish(variables, state)


@functools.partial(jax.jit, static_argnums=0)
def _project(model: LogVGGT, variables: Variables, register_tokens: jax.Array) -> RegisterKeys:
    return model.project_registers(variables, register_tokens)


@functools.partial(jax.jit, static_argnums=0, static_argnames="size")
def _fire(
    model: LogVGGT,
    variables: Variables,
    camera_tokens: jax.Array,
    registers: jax.Array | RegisterKeys | None,
    refined: jax.Array,
    start: jax.Array,
    stop: jax.Array,
    *,
    size: int,
) -> tuple[jax.Array, jax.Array]:
    """One trigger: refined tokens with frames [start, stop) added, and pose encodings [size, 9] from `start`.

    `size` is at least stop − start; entries beyond mean nothing.
    """
    settings, group = model.config.refinement, model.config.windows.stride
    seen = (jnp.arange(camera_tokens.shape[1]) < stop)[None]
    fresh = jax.lax.dynamic_slice_in_dim(camera_tokens, start, size, axis=1)
    if isinstance(registers, RegisterKeys):
        fresh = model.attend_registers(variables, fresh, registers, seen)
    elif registers is not None:
        fresh = model.refine_tokens(variables, fresh, registers, seen)
    refined = jax.lax.dynamic_update_slice_in_dim(refined, fresh, start, axis=1)
    if settings.context is None:
        decoded = model.decode_cameras(variables, refined, seen)
        return refined, jax.lax.dynamic_slice_in_dim(decoded, start, size, axis=1)[0, :, -1]

    def one_group(first: jax.Array) -> jax.Array:
        last = jnp.minimum(first + group, stop)
        return model.decode_group(variables, refined, stop[None], first, last)[0, :, -1]

    decoded = jax.lax.map(one_group, start + group * jnp.arange(-(-size // group)))
    return refined, decoded.reshape(-1, decoded.shape[-1])[:size]


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
    constant but for what refinement reads of every frame (49 kB in VGGT-1B's size; 82 kB with a period and float32
    keys and values); the depth of a frame leaves the device as soon as it is final.

    Args:
      model: the model; `model.config.refinement` sets when poses become final.
      variables: {"params": …}.
      provisional: give results whose pose is not final yet the pose they would have if the stream ended now.
        Costs a run of refinement and camera head over all frames so far at every window.
      chunk: frames by which token buffers grow; a program that reads them compiles once a chunk.
    """

    def __init__(self, model: LogVGGT, variables: Variables, *, provisional: bool = False, chunk: int = 256) -> None:
        if chunk < 1:
            raise ValueError(f"StreamSession.chunk must be at least 1 frame, got {chunk}")
        self._model, self._provisional, self._chunk = model, provisional, chunk
        # Once, not at every call, where they are numpy arrays.
        self._variables = jax.device_put(variables)
        # Windows know nothing of refinement: sessions that differ in its mode share their programs.
        plain = dataclasses.replace(model.config.refinement, enabled=True, period=None, context=None)
        self._windows = LogVGGT(dataclasses.replace(model.config, refinement=plain))
        self._store = TokenStore(chunk=chunk)
        self._pending: list[np.ndarray] = []
        self._state: WindowState | None = None
        self._newest: np.ndarray | None = None
        self._steps = 0
        self._encodings = np.zeros((0, 9), np.float32)
        self._closed = False

    @property
    def num_frames(self) -> int:
        """Frames whose depth is final."""
        return self._store.count

    def push(self, frames: np.ndarray | jax.Array | Sequence[np.ndarray]) -> list[FrameResult]:
        """Takes frames and returns those that became final, oldest first.

        Args:
          frames: one frame [H, W, 3] or several [n, H, W, 3], uint8 or floating point in [0, 1]; H and W are
            multiples of the patch size and the same in every call, as is the dtype.

        Raises:
          ValueError: another shape or dtype, or the session is closed.
        """
        if self._closed:
            raise ValueError("this stream is closed: make another StreamSession for another sequence")
        frames = checked_frames(frames, patch_size=self._model.config.encoder.patch_size, before=self._newest)
        self._image_size = (frames.shape[1], frames.shape[2])
        results: list[FrameResult] = []
        for frame in frames:
            self._pending.append(frame)
            self._newest = frame
            results += self._advance()
        return results

    def close(self) -> list[FrameResult]:
        """Ends the stream: the frames still held, oldest first. Afterwards every pose is final."""
        if self._closed:
            return []
        self._closed = True
        if self._newest is None:
            return []
        if self._state is None:
            self._begin()
        outputs = []
        if self._pending or self._steps == 0:
            outputs.append(self._one_step())
        assert self._state is not None  # set by _begin
        outputs.append(_finish(self._windows, self._variables, self._state))
        self._state = self._newest = None
        return self._collect(outputs)

    def cameras(self, *, provisional: bool = False) -> Cameras:
        """Cameras of the frames whose pose is final; with `provisional` of all frames whose depth is final."""
        encodings = self._all_encodings(provisional=provisional)
        is_final = np.arange(len(encodings)) < len(self._encodings)
        size = self._image_size if len(encodings) else (1, 1)
        # A field of view of zero, which untrained models predict, is an infinite focal length.
        with np.errstate(divide="ignore"):
            extrinsics, intrinsics = decode_poses(encodings, size)
        return Cameras(encodings, extrinsics, intrinsics, is_final)

    def _all_encodings(self, *, provisional: bool) -> np.ndarray:
        """Final pose encodings [N, 9]; with `provisional` those of all frames whose depth is final."""
        if not provisional or len(self._encodings) == self.num_frames:
            return self._encodings
        return np.concatenate([self._encodings, self._refined_until(self.num_frames)[1]])

    def _registers(self, register_tokens: jax.Array) -> jax.Array | RegisterKeys | None:
        """What refinement will read of final frames: where it runs more than once, projected once."""
        settings = self._model.config.refinement
        if not settings.enabled:
            return None
        return register_tokens if settings.period is None else _project(self._model, self._variables, register_tokens)

    def _advance(self) -> list[FrameResult]:
        config = self._model.config.windows
        if self._state is None:
            if len(self._pending) < config.size - config.stride:
                return []
            self._begin()
        return self._collect([self._one_step()]) if len(self._pending) >= config.stride else []

    def _take(self, count: int) -> tuple[jax.Array, jax.Array]:
        """The next `count` pending frames [1, count, H, W, 3] and their mask; a short rest repeats the last."""
        frames, self._pending = self._pending[:count], self._pending[count:]
        assert self._newest is not None
        mask = np.arange(count) < len(frames)
        frames += [self._newest] * (count - len(frames))
        return jnp.asarray(np.stack(frames)[None]), jnp.asarray(mask[None])

    def _begin(self) -> None:
        config = self._model.config.windows
        self._state = _start(self._windows, self._variables, *self._take(config.size - config.stride))

    def _one_step(self) -> WindowOutput:
        frames, mask = self._take(self._model.config.windows.stride)
        assert self._state is not None
        self._state, out = _step(self._windows, self._variables, self._state, frames, mask)
        self._steps += 1
        return out

    def _collect(self, outputs: list[WindowOutput]) -> list[FrameResult]:
        first = self.num_frames
        dense: list[tuple[np.ndarray | None, ...]] = []
        for out in outputs:
            valid = int(np.asarray(out.frame_mask).sum())
            self._store.append(out.camera_tokens, self._registers(out.register_tokens), valid)
            leaves = (out.depth, out.depth_confidence, out.points, out.points_confidence)
            arrays = [None if leaf is None else np.asarray(leaf) for leaf in leaves]
            dense += [tuple(None if a is None else a[0, i] for a in arrays) for i in range(valid)]
        self._fire_due_triggers()
        encodings = self._all_encodings(provisional=self._provisional)
        results = []
        for offset, (depth, confidence, points, points_confidence) in enumerate(dense):
            index = first + offset
            known = index < len(encodings)
            assert depth is not None and confidence is not None
            results.append(
                FrameResult(
                    index=index,
                    depth=depth,
                    confidence=confidence,
                    pose_encoding=encodings[index] if known else None,
                    pose_is_final=index < len(self._encodings),
                    points=points,
                    points_confidence=points_confidence,
                )
            )
        return results

    def _fire_due_triggers(self) -> None:
        period = self._model.config.refinement.period
        while (done := len(self._encodings)) < self.num_frames:
            if self._closed:
                stop = trigger_range(done // (period or 1), self.num_frames, period)[1]
            elif period is not None and self.num_frames >= done + period:
                stop = done + period
            else:
                return
            self._store.refined, encodings = self._refined_until(stop)
            self._encodings = np.concatenate([self._encodings, encodings])

    def _refined_until(self, stop: int) -> tuple[jax.Array, np.ndarray]:
        """Refined tokens and the pose encodings [stop − done, 9] of a trigger that takes the frames to `stop`."""
        store, start = self._store, len(self._encodings)
        period = self._model.config.refinement.period
        # The rest at the end takes a whole number of chunks, unless it fits the period's own program.
        size = -(-(stop - start) // self._chunk) * self._chunk
        size = size if period is None else min(size, period)
        store.reserve(start + size)
        assert store.camera is not None and store.refined is not None
        refined, encodings = _fire(
            self._model,
            self._variables,
            store.camera,
            store.registers,
            store.refined,
            jnp.int32(start),
            jnp.int32(stop),
            size=size,
        )
        return refined, np.asarray(encodings)[: stop - start]
