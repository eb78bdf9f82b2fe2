"""Alternating frame and global attention over the frames of one window."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initializers import normal
from logvggt_jax.model.layers import Block
from logvggt_jax.model.memory import LayerMemory, Memory
from logvggt_jax.model.parameters import run
from logvggt_jax.model.rope import rope_table

BlockFunction = Callable[..., tuple[jax.Array, LayerMemory | None]]


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
    tokens of the window see one another, and what a memory adds).

    Layers run one after the other, or as one loop, whose body is compiled once, where their parameters come stacked
    (see `parameters.stack_layers`). With `remat` the loop keeps a layer's input alone for the backward pass.
    """

    config: ModelConfig
    remat: bool = False

    @nn.compact
    def __call__(
        self,
        patch_tokens: jax.Array,
        lengths: jax.Array | None,
        starts_sequence: jax.Array,
        memory: Memory,
        *,
        grid: tuple[int, int],
    ) -> tuple[WindowTokens, Memory]:
        """Runs all layers over a window.

        Args:
          patch_tokens: [B, K, h * w, C].
          lengths: int32 [B], how many of the K frames are real, always the first ones; nothing attends to the others.
            None for all.
          starts_sequence: bool [B], whether the window's first frame is the sequence's first, which has camera
            and register tokens of its own.
          memory: what the global blocks attend to besides the window: with cross-window attention the caches of the
            key layers, see `cross_window.py`. A loop over the layers leaves it as it is.
          grid: (h, w).

        Returns:
          The tokens, and the memory as the global blocks left it.
        """
        config, sizes = self.config, self.config.aggregator
        batch, frames, _, width = patch_tokens.shape
        num_special = 1 + sizes.num_registers
        special = self._special_tokens(starts_sequence, batch, frames, width)
        x = jnp.concatenate([special, patch_tokens.astype(jnp.float32)], axis=2)
        shape, tokens = x.shape, x.shape[2]
        rope = rope_table(grid, num_special, width // sizes.num_heads, sizes.rope_base)
        valid = None if lengths is None else lengths * tokens

        def within_frames(block: BlockFunction, x: jax.Array) -> jax.Array:
            return block(x.reshape(batch * frames, tokens, width), rope=rope)[0].reshape(shape)

        def over_the_window(
            block: BlockFunction, x: jax.Array, read: LayerMemory | None
        ) -> tuple[jax.Array, LayerMemory | None]:
            x, left = block(x.reshape(batch, frames * tokens, width), rope=rope, valid=valid, memory=read)
            return x.reshape(shape), left

        def block(**options: Any) -> Block:
            return Block(
                sizes.num_heads,
                sizes.mlp_ratio,
                epsilon=1e-5,
                layer_scale=sizes.layer_scale,
                qk_norm=True,
                dtype=config.dtype,
                implementation=config.attention,
                **options,
            )

        if not self.has_variable("params", "global_blocks"):
            key_tokens = []
            for layer in range(sizes.depth):
                frame_out = within_frames(block(name=f"frame_block_{layer}"), x)
                x, left = over_the_window(block(name=f"global_block_{layer}"), frame_out, memory.at(layer))
                if left is not None:
                    memory = memory.updated(layer, left)
                if layer in sizes.key_layers:
                    key_tokens.append(jnp.concatenate([frame_out, x], axis=-1).astype(config.dtype))
            special = jnp.concatenate([frame_out, x], axis=-1)[:, :, :num_special]
            return WindowTokens(jnp.stack(key_tokens, axis=1), special), memory

        readers = [layer for layer in range(sizes.depth) if memory.at(layer) is not None]
        memories = jax.tree.map(lambda *x: jnp.stack(x), *[memory.at(layer) for layer in readers]) if readers else None
        detached = block(parent=None)

        def body(x: jax.Array, inputs: tuple[Any, Any, jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
            frame_params, global_params, reads, place = inputs
            frame_out = within_frames(functools.partial(run, detached, frame_params), x)
            global_block = functools.partial(run, detached, global_params)

            def alone(x: jax.Array) -> jax.Array:
                return over_the_window(global_block, x, None)[0]

            def reading(x: jax.Array) -> jax.Array:
                own = jax.tree.map(lambda m: jax.lax.dynamic_index_in_dim(m, place, keepdims=False), memories)
                return over_the_window(global_block, x, own)[0]

            x = jax.lax.cond(reads, reading, alone, frame_out) if readers else alone(frame_out)
            both = jnp.concatenate([frame_out, x], axis=-1)
            return x, (both.astype(config.dtype), both[:, :, :num_special])

        reads = jnp.array([layer in readers for layer in range(sizes.depth)])
        places = jnp.array([readers.index(layer) if layer in readers else 0 for layer in range(sizes.depth)])
        frame_blocks: Any = self.get_variable("params", "frame_blocks")
        global_blocks: Any = self.get_variable("params", "global_blocks")
        one_layer: Any = jax.checkpoint(body, prevent_cse=False) if self.remat else body
        _, (of_layers, specials) = jax.lax.scan(one_layer, x, (frame_blocks, global_blocks, reads, places))
        return WindowTokens(jnp.moveaxis(of_layers[jnp.array(sizes.key_layers)], 0, 1), specials[-1]), memory

    def _special_tokens(self, starts_sequence: jax.Array, batch: int, frames: int, width: int) -> jax.Array:
        """Camera and register tokens [B, K, 5, C]: copy 0 for the sequence's first frame, copy 1 for others."""
        initial = normal(self.config.aggregator.token_scale)
        camera = self.param("camera_token", initial, (1, 2, 1, width))
        shape = (1, 2, self.config.aggregator.num_registers, width)
        register = self.param("register_token", initial, shape)
        copies = jnp.concatenate([camera, register], axis=2)[0]
        is_first = starts_sequence[:, None] & (jnp.arange(frames) == 0)
        return jnp.where(is_first[..., None, None], copies[0], copies[1])
