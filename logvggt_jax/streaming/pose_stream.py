"""Poses of a stream: GCCR and camera head on its compact tokens, at the triggers that the refinement mode asks for."""

from __future__ import annotations

import copy
import dataclasses
import functools
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import RefinementConfig
from logvggt_jax.model.gccr import RegisterKeys
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.refinement import Span
from logvggt_jax.streaming.results import Progress
from logvggt_jax.streaming.token_store import TokenStore

# Frames beyond which the refinement at the end goes block by block, and the camera head's trunk sees so many frames
# unless the configuration says how many: over all of them it would cost more than the stream did.
LONG_SEQUENCE = 4096
LONG_CONTEXT = 32
_BLOCK = 1024


@functools.partial(jax.jit, static_argnums=0)
def _project(model: LogVGGT, variables: Variables, register_tokens: jax.Array) -> RegisterKeys:
    return model.refinement.project_registers(variables, register_tokens)


def _fire_once(
    model: LogVGGT,
    variables: Variables,
    camera_tokens: jax.Array,
    registers: RegisterKeys | None,
    refined: jax.Array,
    span: Span,
    *,
    size: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One trigger: refined tokens with the span's frames added, and from the span's start pose encodings [size, 9] and
    the corrections [size], how far GCCR moved the tokens, as a fraction of their norm."""
    refined, encodings = model.refinement.fire(variables, camera_tokens, registers, refined, span, size=size)
    before, after = (jax.lax.dynamic_slice_in_dim(x[0], span.start, size) for x in (camera_tokens, refined))
    return refined, encodings[0, :, -1], relative_change(before, after)


_fire = jax.jit(_fire_once, static_argnums=0, static_argnames="size", donate_argnums=4)


@functools.partial(jax.jit, static_argnums=0, static_argnames="size")
def _look_ahead(model: LogVGGT, *arguments: Any, size: int) -> jax.Array:
    """The pose encodings [size, 9] of a trigger that changes nothing."""
    return _fire_once(model, *arguments, size=size)[1]


@functools.partial(jax.jit, static_argnums=0)
def _fire_all(
    model: LogVGGT, variables: Variables, camera_tokens: jax.Array, registers: RegisterKeys | None, count: jax.Array
) -> jax.Array:
    return model.refinement.fire_all(variables, camera_tokens, registers, count[None])[0, :, -1]


def in_one_mode(model: LogVGGT) -> LogVGGT:
    """The model with one mode of refinement, whichever it has: sessions that differ in it share programs that do not
    depend on it."""
    mode = dataclasses.replace(model.config.refinement, enabled=True, period=None, context=None, max_registers=None)
    return LogVGGT(dataclasses.replace(model.config, refinement=mode))


def relative_change(before: jax.Array, after: jax.Array) -> jax.Array:
    """‖after − before‖ / ‖before‖ over the last axis."""
    return jnp.linalg.norm(after - before, axis=-1) / jnp.linalg.norm(before, axis=-1)


class Poses(NamedTuple):
    """Poses that a trigger made final; the first `valid` entries are frames.

    Attributes:
      encodings: [n, 9] float32, on the device.
      corrections: [n] float32, ‖refined − camera token‖ / ‖camera token‖.
      valid: how many count.
    """

    encodings: jax.Array
    corrections: jax.Array
    valid: int


class PoseStream:
    """Takes the compact tokens of frames as they become final and gives poses when they are due.

    Args:
      model: the model; its `refinement` says when poses are due.
      variables: {"params": …}.
      first_capacity: frames that the token buffers hold at first.
      late: frames that may be asked for by `provisional` after others have come, at most.
    """

    def __init__(self, model: LogVGGT, variables: Variables, *, first_capacity: int, late: int) -> None:
        self._model, self._variables, self._first_capacity = model, variables, first_capacity
        config = model.config.refinement
        # The registers of a frame are projected alike in every mode.
        self._projecting = in_one_mode(model)
        reach = max_frames = None
        if config.period is not None and config.context is not None:
            reach = config.period + config.context + late + 2 * model.config.windows.size
        if config.enabled:
            max_frames = model.refinement.max_frames
        self._store = TokenStore(first_capacity=first_capacity, reach=reach, max_frames=max_frames)
        # Frames whose pose some trigger has taken.
        self.num_refined = 0

    @property
    def num_frames(self) -> int:
        """Frames whose tokens are here."""
        return self._store.count

    @property
    def filled_bytes(self) -> int:
        """Bytes of the tokens that are kept, without empty places."""
        return self._store.filled_bytes

    def append(self, camera_tokens: jax.Array, register_tokens: jax.Array, valid: int) -> list[Poses]:
        """Adds the first `valid` of n frames, [1, n, 2C] and [1, n, 4, 2C]; the poses that are due, oldest first."""
        registers = None
        if self._model.config.refinement.enabled:
            registers = _project(self._projecting, self._variables, register_tokens)
        self._store.append(camera_tokens, registers, valid)
        period, poses = self._model.config.refinement.period, []
        while period is not None and self._store.count >= self.num_refined + period:
            poses.append(self._trigger(self._model, self.num_refined + period, size=period))
        return poses

    def finish(self, progress: Progress | None = None) -> list[Poses]:
        """The poses of the frames that no trigger has taken.

        Where all frames of a long sequence are refined at the end, `progress` is told how many are done, of how many.
        """
        count, config = self._store.count, self._model.config.refinement
        if self.num_refined == count:
            return []
        if config.period is not None:
            return [self._trigger(self._model, count, size=config.period)]
        if count <= LONG_SEQUENCE:
            # What reads all frames runs once: at their number, not at the buffers' size.
            self._store.resize(self._first_capacity)
            return [self._trigger(self._model, count, size=self._store.capacity)]
        # In whole groups of one stride, in which poses are decoded.
        stride = self._model.config.windows.stride
        block, poses = stride * max(_BLOCK // stride, 1), []
        model = self._model_for(count, said=True)
        self._store.resize(block)
        while self.num_refined < count:
            stop = min(self.num_refined + block, count)
            poses.append(self._trigger(model, stop, size=block, seen=count))
            if progress is not None:
                poses[-1].encodings.block_until_ready()
                progress(stop, count)
        return poses

    def provisional(self, start: int, stop: int) -> np.ndarray:
        """Pose encodings [stop - start, 9] that frames would have if the stream had ended at `stop`."""
        store, period = self._store, self._model.config.refinement.period
        if period is not None:
            store.reserve(start + period)
        registers, seen = store.registers_at(stop)
        encodings = _look_ahead(
            self._model_for(store.count),
            self._variables,
            store.camera,
            registers,
            store.refined,
            self._span(start, stop, seen),
            size=store.capacity if period is None else period,
        )
        return np.asarray(encodings)[: stop - start]

    def all_with(self, refinement: RefinementConfig) -> np.ndarray:
        """Pose encodings [N, 9] of all frames as another mode of refinement gives them.

        Raises:
          ValueError: there is no frame; the store has not kept what that mode reads.
        """
        store = self._store
        if store.camera is None:
            raise ValueError("another mode of refinement needs frames, this stream had none")
        if not store.keeps_all:
            raise ValueError("this stream has forgotten old tokens; open it without max_registers, period and context")
        if refinement.enabled and store.registers is None:
            raise ValueError("this stream ran with refinement off and kept no registers; open it with refinement on")
        model = LogVGGT(dataclasses.replace(self._model.config, refinement=refinement))
        registers = store.registers if refinement.enabled else None
        encodings = _fire_all(model, self._variables, store.camera, registers, jnp.int32(store.count))
        return np.asarray(encodings)[: store.count]

    def copy(self) -> PoseStream:
        """A stream of its own that goes on from here."""
        other = copy.copy(self)
        other._store = self._store.copy()
        return other

    def arrays(self) -> dict[str, np.ndarray]:
        """What `restore` needs to go on from here."""
        return {**self._store.arrays(), "refined_count": np.array([self.num_refined])} if self._store.count else {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave."""
        if arrays:
            self._store.restore(arrays)
            self.num_refined = int(arrays["refined_count"][0])

    def _trigger(self, model: LogVGGT, stop: int, *, size: int, seen: int | None = None) -> Poses:
        """Takes the frames up to `stop`, against the registers of the first `seen` (by default `stop`)."""
        store, start = self._store, self.num_refined
        store.reserve(start + size)
        registers, kept = store.registers_at(stop if seen is None else seen)
        store.refined, encodings, corrections = _fire(
            model,
            self._variables,
            store.camera,
            registers,
            store.refined,
            self._span(start, stop, kept),
            size=size,
        )
        self.num_refined = stop
        return Poses(encodings, corrections, stop - start)

    def _span(self, start: int, stop: int, seen: jax.Array) -> Span:
        """The span at its frames' places in the buffers."""
        first, last = self._store.position(start), self._store.position(stop)
        return Span(jnp.int32(first), jnp.int32(last), jnp.full(1, last, jnp.int32), seen)

    def _model_for(self, count: int, *, said: bool = False) -> LogVGGT:
        """The model, with a limited context where a long sequence is refined at the end."""
        config = self._model.config.refinement
        if config.period is not None or config.context is not None or count <= LONG_SEQUENCE:
            return self._model
        if said:
            warnings.warn(
                f"{count:,} frames are more than the camera head looks at together: it sees {LONG_CONTEXT} frames up "
                "to each one; the model's refinement.context sets another number",
                stacklevel=2,
            )
        limited = dataclasses.replace(config, context=max(LONG_CONTEXT, self._model.config.windows.stride))
        return LogVGGT(dataclasses.replace(self._model.config, refinement=limited))
