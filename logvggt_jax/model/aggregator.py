"""Alternating frame and global attention over the frames of one window."""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initializers import normal
from logvggt_jax.model.layers import Block
from logvggt_jax.model.memory import Memory
from logvggt_jax.model.rope import rope_table


class WindowTokens(NamedTuple):
    """What the blocks make of one window's K frames.

    Attributes:
      key: [B, key layers, K, P, 2C] in the compute type: the key layers' tokens, the frame block's output before the
        global block's on channels.
      special: [B, K, 1 + registers, 2C] float32: camera and register tokens of the last layer, in the same form.
    """

    key: jax.Array
    special: jax.Array


class Aggregator(nn.Module):
    """VGGT's trunk: in every layer a frame block (tokens of one frame see one another), then a global block (all
    tokens of the window see one another, and what a memory adds)."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        patch_tokens: jax.Array,
        lengths: jax.Array,
        starts_sequence: jax.Array,
        memory: Memory,
        *,
        grid: tuple[int, int],
    ) -> tuple[WindowTokens, Memory]:
        """Runs all layers over a window.

        Args:
          patch_tokens: [B, K, h * w, C].
          lengths: int32 [B], how many of the K frames are real, always the first ones; nothing attends to the others.
          starts_sequence: bool [B], whether the window's first frame is the sequence's first, which has camera
            and register tokens of its own.
          memory: what the global blocks attend to besides the window: with cross-window attention the caches of the
            key layers, see `cross_window.py`.
          grid: (h, w).

        Returns:
          The tokens, and the memory as the global blocks left it.
        """
        config, sizes = self.config, self.config.aggregator
        batch, frames, _, width = patch_tokens.shape
        special = self._special_tokens(starts_sequence, batch, frames, width)
        x = jnp.concatenate([special, patch_tokens.astype(jnp.float32)], axis=2)
        tokens = x.shape[2]
        table = rope_table(grid, 1 + sizes.num_registers, width // sizes.num_heads, sizes.rope_base)

        def block(name: str) -> Block:
            return Block(
                sizes.num_heads,
                sizes.mlp_ratio,
                epsilon=1e-5,
                layer_scale=sizes.layer_scale,
                qk_norm=True,
                dtype=config.dtype,
                implementation=config.attention,
                name=name,
            )

        key_tokens = []
        both = x
        for layer in range(sizes.depth):
            frame_out, _ = block(f"frame_block_{layer}")(x.reshape(batch * frames, tokens, width), rope=table)
            x, left = block(f"global_block_{layer}")(
                frame_out.reshape(batch, frames * tokens, width),
                rope=table,
                valid=lengths * tokens,
                memory=memory.at(layer),
            )
            if left is not None:
                memory = memory.updated(layer, left)
            if layer in sizes.key_layers or layer == sizes.depth - 1:
                shape = (batch, frames, tokens, width)
                both = jnp.concatenate([frame_out.reshape(shape), x.reshape(shape)], axis=-1)
            if layer in sizes.key_layers:
                key_tokens.append(both.astype(config.dtype))
        return WindowTokens(jnp.stack(key_tokens, axis=1), both[:, :, : 1 + sizes.num_registers]), memory

    def _special_tokens(self, starts_sequence: jax.Array, batch: int, frames: int, width: int) -> jax.Array:
        """Camera and register tokens [B, K, 5, C]: copy 0 for the sequence's first frame, copy 1 for others."""
        initial = normal(self.config.aggregator.token_scale)
        camera = self.param("camera_token", initial, (1, 2, 1, width))
        shape = (1, 2, self.config.aggregator.num_registers, width)
        register = self.param("register_token", initial, shape)
        copies = jnp.concatenate([camera, register], axis=2)[0]
        is_first = starts_sequence[:, None] & (jnp.arange(frames) == 0)
        return jnp.where(is_first[..., None, None], copies[0], copies[1])
