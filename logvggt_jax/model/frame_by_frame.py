"""Streams of single frames: each attends to itself and to what caches have kept of the frames before it.

    global blocks   the frame's tokens, and the memory's (`key_value_cache.py`, `rolling_cache.py`)
    dense heads     the frame's own tokens
    camera head     the frame's camera token, and the trunk's caches; with GCCR, the registers that are kept

`whole` gives the same for a memory that forgets nothing, from one call over the whole sequence with a mask: the form in
which such weights are trained.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.aggregator import WindowTokens
from logvggt_jax.model.key_value_cache import CameraMemory, with_registers
from logvggt_jax.model.memory import (
    Attend,
    FixedMemory,
    Keys,
    LayerMemory,
    Memory,
    OwnTokens,
    Project,
    RoundMemory,
)
from logvggt_jax.model.parameters import Variables, run
from logvggt_jax.model.refinement import Refinement
from logvggt_jax.model.windows import Windows
from logvggt_jax.types import WindowOutput


@struct.dataclass
class CausalMask(FixedMemory):
    """The mask of a whole sequence of `frames` equally long frames, at every layer: a frame sees itself and all before
    it. It remembers nothing."""

    frames: int = struct.field(pytree_node=False)

    def at(self, layer: int) -> CausalMask:
        """The same mask at every layer."""
        del layer
        return self

    def attend(self, own: OwnTokens, attention: Attend, project: Project) -> tuple[jax.Array, LayerMemory]:
        """Frame by frame, each to a longer part of the same keys."""
        del project
        batch, length = own.query.shape[:2]
        tokens = length // self.frames
        queries = jnp.moveaxis(own.query.reshape(batch, self.frames, tokens, *own.query.shape[2:]), 1, 0)

        def one_frame(query: jax.Array, index: jax.Array) -> jax.Array:
            count = jnp.broadcast_to((index + 1) * tokens, (batch,))
            return attention(query, Keys(own.keys.key, own.keys.value, count))

        taken = jax.lax.map(lambda frame: one_frame(*frame), (queries, jnp.arange(self.frames)))
        return jnp.moveaxis(taken, 0, 1).reshape(own.query.shape), self


@dataclasses.dataclass(frozen=True)
class FrameByFrame:
    """The parts of the model one frame at a time; pure functions of parameters, memories and arrays."""

    config: ModelConfig

    def step(
        self, variables: Variables, memory: Memory, frames: jax.Array, is_first: jax.Array
    ) -> tuple[Memory, WindowOutput]:
        """Takes the next frame of B sequences; its depth and compact tokens, [B, 1, …].

        Args:
          variables: {"params": …}.
          memory: of the global blocks; may be donated.
          frames: [B, 1, H, W, 3].
          is_first: bool [B], whether it is the sequence's first frame.
        """
        tokens, memory = self.tokens(variables, memory, frames, is_first)
        mask, image_size = jnp.ones(frames.shape[:2], bool), (frames.shape[2], frames.shape[3])
        return memory, self._windows.decode_dense(variables, tokens, mask, image_size)

    def tokens(
        self, variables: Variables, memory: Memory, frames: jax.Array, is_first: jax.Array
    ) -> tuple[WindowTokens, Memory]:
        """Encoder and attention of `step`; several frames [B, n, H, W, 3] see what the memory lets them see."""
        windows = self._windows
        grid = windows.grid((frames.shape[2], frames.shape[3]))
        params, patch_tokens = variables["params"]["aggregator"], windows.encode(variables, frames)
        tokens: tuple[WindowTokens, Memory] = run(
            windows.aggregator, params, patch_tokens, None, is_first, memory, grid=grid
        )
        return tokens

    def locate(
        self, variables: Variables, memory: CameraMemory, camera_tokens: jax.Array, register_tokens: jax.Array
    ) -> tuple[CameraMemory, jax.Array]:
        """The next frame's pose encodings [B, 1, R, 9] of all rounds.

        Args:
          variables: {"params": …}.
          memory: may be donated.
          camera_tokens: [B, 1, 2C].
          register_tokens: [B, 1, 4, 2C].
        """
        refinement, registers = self._refinement, memory.registers
        if registers is not None:
            own = refinement.project_registers(variables, register_tokens)
            seen, count, registers = with_registers(registers, own)
            camera_tokens = refinement.attend_registers(variables, camera_tokens, seen, count)
        encodings, trunk = self._decode(variables, camera_tokens, memory.trunk)
        return CameraMemory(trunk, registers), encodings

    def whole(self, variables: Variables, images: jax.Array) -> tuple[WindowOutput, jax.Array]:
        """A whole sequence [B, T, H, W, 3] under the causal mask: depth and compact tokens, and pose encodings
        [B, T, R, 9]. Equal to a stream with a cache that keeps everything, one a round in the camera head."""
        batch, count = images.shape[:2]
        mask = CausalMask(count)
        tokens, _ = self.tokens(variables, mask, images, jnp.ones(batch, bool))
        frame_mask, image_size = jnp.ones((batch, count), bool), (images.shape[2], images.shape[3])
        out = self._windows.decode_dense(variables, tokens, frame_mask, image_size)
        refined, refinement = out.camera_tokens, self._refinement
        if self.config.refinement.enabled:
            registers = refinement.project_registers(variables, out.register_tokens)

            def one_frame(index: jax.Array) -> jax.Array:
                own = jax.lax.dynamic_slice_in_dim(out.camera_tokens, index, 1, axis=1)
                seen = jnp.broadcast_to(index + 1, (batch,))
                return refinement.attend_registers(variables, own, registers, seen)[:, 0]

            refined = jnp.moveaxis(jax.lax.map(one_frame, jnp.arange(count)), 0, 1)
        encodings, _ = self._decode(variables, refined, RoundMemory(shared=mask))
        return out, encodings

    def _decode(
        self, variables: Variables, camera_tokens: jax.Array, memory: RoundMemory
    ) -> tuple[jax.Array, RoundMemory]:
        head, params = self._refinement.camera_head, variables["params"]["camera_head"]
        decoded: tuple[jax.Array, RoundMemory] = run(head, params, camera_tokens, None, memory)
        return decoded

    @property
    def _windows(self) -> Windows:
        return Windows(self.config)

    @property
    def _refinement(self) -> Refinement:
        return Refinement(self.config)
