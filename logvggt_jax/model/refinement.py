"""When GCCR runs and which frames the camera head sees: full sequence, periodic, online, limited context.

A trigger refines a span of frames against the registers of the frames so far and decodes their poses. `fire` is the
only one: `LogVGGT.apply` loops over it, streams call it when it is due, and operations are counted on its halves.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.camera_head import CameraHead
from logvggt_jax.model.checks import check_array
from logvggt_jax.model.gccr import GCCR, RegisterKeys
from logvggt_jax.model.kept_registers import is_kept
from logvggt_jax.model.padding import with_places
from logvggt_jax.model.parameters import Variables, run


def num_triggers(num_frames: int, period: int | None) -> int:
    """How often GCCR runs over `num_frames` frames: once without a period, else every `period` frames."""
    return 1 if period is None else -(-num_frames // period)


class Span(NamedTuple):
    """The frames [start, stop) that a trigger takes, of sequences of unequal length.

    Attributes:
      start: int32 scalar.
      stop: int32 scalar.
      lengths: int32 [B], the sequences' numbers of frames.
      seen: the frames whose registers count: the first so many, int32 [B], or bool [B, M].
    """

    start: jax.Array
    stop: jax.Array
    lengths: jax.Array
    seen: jax.Array


@dataclasses.dataclass(frozen=True)
class Refinement:
    """GCCR and camera head over the compact tokens of sequences; pure functions of parameters and arrays."""

    config: ModelConfig

    # One trigger.

    def fire(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        registers: RegisterKeys | None,
        refined: jax.Array,
        span: Span,
        *,
        size: int,
    ) -> tuple[jax.Array, jax.Array]:
        """One trigger: the frames of a span are refined and get their poses.

        What lies at or beyond the span's stop, or an item's own length, means nothing and is seen by none.

        Args:
          variables: {"params": …}.
          camera_tokens: [B, N, 2C], N at least start + size.
          registers: of M frames, see `project_registers`; None where GCCR is off.
          refined: [B, N, 2C], the refined tokens of frames before the span.
          span: the frames.
          size: static, at least the span's length.

        Returns:
          `refined` with the span's tokens in their place, and pose encodings [B, size, R, 9] from the span's start.
        """
        refined = self.refine_span(variables, camera_tokens, registers, refined, span, size=size)
        return refined, self.decode_span(variables, refined, span, size=size)

    def refine_span(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        registers: RegisterKeys | None,
        refined: jax.Array,
        span: Span,
        *,
        size: int,
    ) -> jax.Array:
        """GCCR's half of `fire`."""
        fresh = jax.lax.dynamic_slice_in_dim(camera_tokens, span.start, size, axis=1)
        if registers is not None:
            fresh = self.attend_registers(variables, fresh, registers, span.seen)
        return jax.lax.dynamic_update_slice_in_dim(refined, fresh, span.start, axis=1)

    def decode_span(self, variables: Variables, refined: jax.Array, span: Span, *, size: int) -> jax.Array:
        """The camera head's half of `fire`: over all frames so far, or group by group with a limited context."""
        group = self.config.windows.stride
        if self.config.refinement.context is None:
            decoded = self.decode_cameras(variables, refined, jnp.minimum(span.lengths, span.stop))
            return jax.lax.dynamic_slice_in_dim(decoded, span.start, size, axis=1)

        def one_group(first: jax.Array) -> jax.Array:
            last = jnp.minimum(first + group, span.stop)
            return self._decode_group(variables, refined, span._replace(start=first, stop=last))

        decoded = jax.lax.map(one_group, span.start + group * jnp.arange(-(-size // group)))
        decoded = jnp.moveaxis(decoded, 0, 1)
        return decoded.reshape(decoded.shape[0], -1, *decoded.shape[3:])[:, :size]

    def _decode_group(self, variables: Variables, refined: jax.Array, span: Span) -> jax.Array:
        """Pose encodings [B, s, R, 9] of the frames of a span of at most s.

        The trunk sees frame 0 and the `context` frames up to the span's stop, or to the item's own end if that comes
        first.
        """
        context = self.config.refinement.context
        assert context is not None  # decode_span has looked
        ends = jnp.minimum(span.stop, span.lengths)[:, None]
        oldest = jnp.maximum(ends - context, 0)
        recent = jnp.take_along_axis(refined, (oldest + jnp.arange(context))[..., None], axis=1, mode="clip")
        # Frame 0 has a place of its own, the last one, only where the recent frames do not include it.
        tokens = jnp.concatenate([recent, refined[:, :1]], axis=1)
        encodings = self.decode_cameras(variables, tokens, jnp.minimum(ends[:, 0], context + 1))
        places = jnp.clip(span.start + jnp.arange(self.config.windows.stride) - oldest, 0, context)
        return jnp.take_along_axis(encodings, places[..., None, None], axis=1)

    # All triggers.

    def refine_sequence(
        self, variables: Variables, camera_tokens: jax.Array, register_tokens: jax.Array, frame_mask: jax.Array
    ) -> jax.Array:
        """Pose encodings [B, T, R, 9] of whole sequences in the configured mode: full, periodic or online.

        Args:
          variables: {"params": …}.
          camera_tokens: [B, T, 2C].
          register_tokens: [B, T, 4, 2C].
          frame_mask: bool [B, T], True … True False … False.
        """
        registers = self.project_registers(variables, register_tokens) if self.config.refinement.enabled else None
        return self.fire_all(variables, camera_tokens, registers, frame_mask.sum(1))

    def fire_all(
        self, variables: Variables, camera_tokens: jax.Array, registers: RegisterKeys | None, lengths: jax.Array
    ) -> jax.Array:
        """Pose encodings [B, T, R, 9] of sequences whose registers are projected already.

        Args:
          variables: {"params": …}.
          camera_tokens: [B, T, 2C].
          registers: of T frames; None where GCCR is off.
          lengths: int32 [B], the items' numbers of frames, at most T.
        """
        num_frames, period = camera_tokens.shape[1], self.config.refinement.period
        size = num_frames if period is None else min(period, num_frames)
        triggers = num_triggers(num_frames, size)
        # Room for the last trigger's full size: spans keep one shape.
        padding = triggers * size - num_frames
        camera_tokens, registers = jax.tree.map(lambda x: with_places(x, padding, axis=1), (camera_tokens, registers))

        def one_trigger(refined: jax.Array, start: jax.Array) -> tuple[jax.Array, jax.Array]:
            stop = jnp.minimum(start + size, num_frames)
            span = Span(start, stop, lengths, self.registers_seen(jnp.minimum(lengths, stop), camera_tokens.shape[1]))
            return self.fire(variables, camera_tokens, registers, refined, span, size=size)

        _, encodings = jax.lax.scan(one_trigger, camera_tokens, size * jnp.arange(triggers))
        encodings = jnp.moveaxis(encodings, 0, 1)
        return encodings.reshape(encodings.shape[0], -1, *encodings.shape[3:])[:, :num_frames]

    def refine(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        register_tokens: jax.Array,
        camera_mask: jax.Array,
        register_mask: jax.Array,
    ) -> jax.Array:
        """GCCR and camera head over the tokens at hand; see `LogVGGT.refine`."""
        refined = self.refine_tokens(variables, camera_tokens, register_tokens, register_mask)
        return self.decode_cameras(variables, refined, camera_mask)

    def registers_seen(self, counts: jax.Array, num_frames: int) -> jax.Array:
        """The frames whose registers count once the first `counts`, int32 [B], of `num_frames` are there.

        As `attend_registers` takes them: the first so many, or bool [B, num_frames] where their number is bounded.
        """
        if self.max_frames is None or num_frames <= self.max_frames:
            return counts
        return is_kept(jnp.arange(num_frames), counts[:, None], self.max_frames)

    # The parts of a trigger.

    def refine_tokens(
        self, variables: Variables, camera_tokens: jax.Array, register_tokens: jax.Array, register_mask: jax.Array
    ) -> jax.Array:
        """GCCR alone: [B, N, 2C], [B, M, 4, 2C], bool [B, M] -> [B, N, 2C]; the identity when disabled."""
        if not self.config.refinement.enabled:
            return camera_tokens
        registers, width = self.config.aggregator.num_registers, self._width
        check_array("camera_tokens", camera_tokens, (None, None, width), jnp.floating)
        check_array("register_tokens", register_tokens, (len(camera_tokens), None, registers, width), jnp.floating)
        keys = self.project_registers(variables, register_tokens)
        return self.attend_registers(variables, camera_tokens, keys, register_mask)

    def project_registers(self, variables: Variables, register_tokens: jax.Array) -> RegisterKeys:
        """GCCR's keys and values of register tokens [B, M, 4, 2C], frame by frame.

        A stream projects each frame once; over again for every trigger, the cost a frame would grow with the
        sequence.
        """
        width, registers = self._width, self.config.aggregator.num_registers
        check_array("register_tokens", register_tokens, (None, None, registers, width), jnp.floating)
        return run(self.gccr, variables["params"]["gccr"], register_tokens, method=GCCR.project)

    def attend_registers(
        self, variables: Variables, camera_tokens: jax.Array, registers: RegisterKeys, frames: jax.Array
    ) -> jax.Array:
        """GCCR after `project_registers`: [B, N, 2C] and M frames' keys and values -> [B, N, 2C].

        `frames` says whose registers count: bool [B, M], or the first so many, int32 [B].
        """
        check_array("camera_tokens", camera_tokens, (len(registers.key), None, self._width), jnp.floating)
        if frames.ndim != 1:
            check_array("register_mask", frames, registers.key.shape[:2], jnp.bool_)
        return run(self.gccr, variables["params"]["gccr"], camera_tokens, registers, frames, method=GCCR.attend)

    def decode_cameras(self, variables: Variables, camera_tokens: jax.Array, frames: jax.Array) -> jax.Array:
        """Camera head alone: refined tokens [B, N, 2C] -> pose encodings [B, N, R, 9].

        `frames` says which of them count: bool [B, N], or the first so many, int32 [B].
        """
        check_array("camera_tokens", camera_tokens, (None, None, self._width), jnp.floating)
        if frames.ndim != 1:
            check_array("camera_mask", frames, camera_tokens.shape[:2], jnp.bool_)
        encodings, _ = run(self.camera_head, variables["params"]["camera_head"], camera_tokens, frames)
        return encodings

    @property
    def camera_head(self) -> CameraHead:
        """From camera tokens to pose encodings, in rounds."""
        return CameraHead(self.config.camera_head, self.config.attention)

    @property
    def gccr(self) -> GCCR:
        """From camera tokens to refined ones."""
        return GCCR(self._width, self.config.refinement.num_heads, self.config.dtype, self.config.attention)

    @property
    def max_frames(self) -> int | None:
        """Frames whose registers are kept at most; None for all."""
        bound = self.config.refinement.max_registers
        return None if bound is None else bound // self.config.aggregator.num_registers

    @property
    def _width(self) -> int:
        return 2 * self.config.encoder.embed_dim
