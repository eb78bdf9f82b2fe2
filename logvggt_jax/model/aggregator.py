"""Alternating frame and global attention over one window, with cross-window attention at the key layers."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initializers import normal
from logvggt_jax.model.layers import Block
from logvggt_jax.model.rope import frame_positions, rope_table


class Aggregator(nn.Module):
    """Patch tokens of one window to key-layer tokens and special tokens."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        patch_tokens: jax.Array,
        frame_mask: jax.Array,
        cached_tokens: jax.Array,
        cached_mask: jax.Array,
        starts_sequence: jax.Array,
        *,
        grid: tuple[int, int],
    ) -> tuple[jax.Array, jax.Array]:
        """Runs all blocks over a window (VGGT; paper, equation of cross-window attention, at the key layers).

        Args:
          patch_tokens: [B, K, h * w, C].
          frame_mask: bool [B, K], False for padding, which nothing attends to.
          cached_tokens: [B, key layers, F, P, C], what the previous window left.
          cached_mask: bool [B, F], False for cached frames that are padding or do not exist.
          starts_sequence: bool [B], whether the window's first frame is the sequence's first, which has camera
            and register tokens of its own.
          grid: (h, w).

        Returns:
          key_tokens [B, key layers, K, P, 2C] in the compute dtype, frame-block output before global-block output
          on channels; special tokens [B, K, 5, 2C] float32 of the last block (camera, then registers).
        """
        config, sizes = self.config, self.config.aggregator
        batch, frames, _, width = patch_tokens.shape
        cached_frames = cached_tokens.shape[2]
        special = self._special_tokens(starts_sequence, batch, frames, width)
        x = jnp.concatenate([special, patch_tokens.astype(jnp.float32)], axis=2)
        tokens = x.shape[2]

        positions = frame_positions(grid, 1 + sizes.num_registers)
        table = rope_table(positions, width // sizes.num_heads, sizes.rope_base)
        window_table, longer_table = table.tile(frames), table.tile(frames + cached_frames)
        window_valid = jnp.repeat(frame_mask, tokens, axis=1)
        longer_valid = jnp.repeat(jnp.concatenate([frame_mask, cached_mask], axis=1), tokens, axis=1)

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
            x = x.reshape(batch * frames, tokens, width)
            x = frame_out = block(f"frame_block_{layer}")(x, rope=table)
            x = x.reshape(batch, frames * tokens, width)
            global_block = block(f"global_block_{layer}")
            if layer in sizes.key_layers and config.windows.cross_window:
                cached = cached_tokens[:, sizes.key_layers.index(layer)].astype(jnp.float32)
                x = global_block(
                    x,
                    rope=longer_table,
                    extra=cached.reshape(batch, cached_frames * tokens, width),
                    key_valid=longer_valid,
                )
            else:
                x = global_block(x, rope=window_table, key_valid=window_valid)
            shape = (batch, frames, tokens, width)
            if layer in sizes.key_layers or layer == sizes.depth - 1:
                both = jnp.concatenate([frame_out.reshape(shape), x.reshape(shape)], axis=-1)
            if layer in sizes.key_layers:
                key_tokens.append(both.astype(config.dtype))
        return jnp.stack(key_tokens, axis=1), both[:, :, : 1 + sizes.num_registers]

    def _special_tokens(self, starts_sequence: jax.Array, batch: int, frames: int, width: int) -> jax.Array:
        """Camera and register tokens [B, K, 5, C]: copy 0 for the sequence's first frame, copy 1 for others."""
        initial = normal(self.config.aggregator.token_scale)
        camera = self.param("camera_token", initial, (1, 2, 1, width))
        shape = (1, 2, self.config.aggregator.num_registers, width)
        register = self.param("register_token", initial, shape)
        copies = jnp.concatenate([camera, register], axis=2)[0]
        is_first = starts_sequence[:, None] & (jnp.arange(frames) == 0)
        return jnp.where(is_first[..., None, None], copies[0], copies[1])
