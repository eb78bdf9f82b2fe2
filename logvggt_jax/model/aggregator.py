"""Alternating frame and global attention over the frames of one window."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initializers import normal
from logvggt_jax.model.layers import Block, with_special
from logvggt_jax.model.memory import FixedMemory, LayerMemory, Memory, in_loop
from logvggt_jax.model.parameters import given, run
from logvggt_jax.model.rope import rope_table
from logvggt_jax.model.shape_check import ShapeCheck

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


class Aggregator(ShapeCheck, nn.Module):
    """VGGT's trunk, alternating attention. With H^(l) the window's tokens [B, K, P, C] before layer l:

        F^(l)   = frame block l of H^(l)     tokens of one frame see one another
        H^(l+1) = global block l of F^(l)    all tokens of the window see one another, and what a memory adds

    What the memory adds at the key layers is the equation of cross-window attention, see `cross_window.py`.

    Layers run one after the other. Where their parameters come stacked (see `parameters.stack_layers`) all of them are
    one loop, whose body is compiled once; with a memory that they change they run one by one. The loop is what training
    wants: by itself a layer on a GPU is faster, by a tenth of a stream's step (README.md), and in the loop one that
    reads a memory is told from others only when it runs. With `remat` a stacked layer keeps nothing but its input for
    the backward pass.
    """

    config: ModelConfig
    remat: bool = False

    @nn.compact
    def __call__(
        self,
        patch_tokens: jax.Array,
        lengths: jax.Array | None,
        starts_sequence: jax.Array,
        memory: Memory | None,
        *,
        grid: tuple[int, int],
        seen: jax.Array | None = None,
    ) -> tuple[WindowTokens, Memory | None]:
        """Runs all layers over a window.

        Args:
          patch_tokens: [B, K, h * w, C].
          lengths: int32 [B], how many of the K frames are real, always the first ones; nothing attends to the others.
            None for all.
          starts_sequence: bool [B], whether the window's first frame is the sequence's first, which has camera
            and register tokens of its own.
          memory: what the global blocks attend to besides the window: with cross-window attention the caches of the
            key layers, see `cross_window.py`. None for the window alone.
          grid: (h, w).
          seen: bool [B, K, h * w], False for patches that nothing attends to, see `masks.py`; None for all. A memory
            then gets its block's own keys with a validity bool [B, K · P].

        Returns:
          The tokens, and the memory as the global blocks left it.
        """
        config, sizes = self.config, self.config.aggregator
        batch, frames, _, width = patch_tokens.shape
        num_special = sizes.num_special
        special = self._special_tokens(starts_sequence, frames, width)
        x = jnp.concatenate([special, patch_tokens.astype(jnp.float32)], axis=2)
        shape, tokens = x.shape, x.shape[2]
        rope = rope_table(grid, num_special, width // sizes.num_heads, sizes.rope_base)
        valid = None if lengths is None else lengths * tokens
        frame_valid = None
        if seen is not None:
            in_frame = with_special(seen, num_special)
            frame_valid = in_frame.reshape(batch * frames, tokens)
            real = jnp.full(batch, frames) if lengths is None else lengths
            valid = (in_frame & (jnp.arange(frames) < real[:, None])[..., None]).reshape(batch, frames * tokens)

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

        def one_layer(
            frame_block: BlockFunction, global_block: BlockFunction, x: jax.Array, read: LayerMemory | None
        ) -> tuple[jax.Array, jax.Array, LayerMemory | None]:
            """Outputs of both blocks [B, K, P, C], and the memory that the global block leaves."""
            frame_out, _ = frame_block(x.reshape(batch * frames, tokens, width), rope=rope, valid=frame_valid)
            x, left = global_block(
                frame_out.reshape(batch, frames * tokens, width), rope=rope, valid=valid, memory=read
            )
            return frame_out.reshape(shape), x.reshape(shape), left

        def joined(frame_out: jax.Array, global_out: jax.Array) -> jax.Array:
            return jnp.concatenate([frame_out, global_out], axis=-1)

        def by_parameters(
            params: tuple[Any, ...], x: jax.Array, read: LayerMemory | None = None
        ) -> tuple[jax.Array, jax.Array, LayerMemory | None]:
            frame_block, global_block = (functools.partial(run, block(parent=None), each) for each in params)
            return one_layer(frame_block, global_block, x, read)

        stacks: Any = None
        if self.has_variable("params", "global_blocks"):
            stacks = self.get_variable("params", "frame_blocks"), self.get_variable("params", "global_blocks")
            if self.remat:
                by_parameters = jax.checkpoint(by_parameters, prevent_cse=False)

        def one_by_one(x: jax.Array, memory: Memory | None) -> tuple[WindowTokens, Memory | None]:
            key: list[jax.Array] = []
            for layer in range(sizes.depth):
                read = None if memory is None else memory.at(layer)
                names = f"frame_block_{layer}", f"global_block_{layer}"
                if stacks is not None:
                    frame_out, x, left = by_parameters(jax.tree.map(lambda stack, i=layer: stack[i], stacks), x, read)
                elif given(self, names[0]):
                    params: Any = tuple(self.get_variable("params", name) for name in names)
                    frame_out, x, left = by_parameters(params, x, read)
                else:
                    frame_out, x, left = one_layer(block(name=names[0]), block(name=names[1]), x, read)
                if memory is not None and left is not None:
                    memory = memory.updated(layer, left)
                if layer in sizes.key_layers:
                    key.append(joined(frame_out, x).astype(config.dtype))
            last = joined(frame_out[:, :, :num_special], x[:, :, :num_special])
            return WindowTokens(jnp.stack(key, axis=1), last), memory

        def as_loop(x: jax.Array, memory: FixedMemory | None) -> WindowTokens:
            rows, read = in_loop(memory, sizes.depth)
            # Every layer writes to the place of the next key layer, whose own tokens come there last.
            places = np.searchsorted(sizes.key_layers, range(sizes.depth))
            key = jnp.zeros((batch, places[-1] + 1, *shape[1:-1], 2 * width), config.dtype)

            def body(carry: Any, layer: Any) -> tuple[tuple[jax.Array, jax.Array, jax.Array], None]:
                x, key, _ = carry
                params, place, row = layer
                frame_out, x, _ = by_parameters(params, x, read(row))
                made = joined(frame_out, x).astype(config.dtype)
                key = jax.lax.dynamic_update_index_in_dim(key, made, place, axis=1)
                return (x, key, frame_out[:, :, :num_special]), None

            (x, key, last), _ = jax.lax.scan(body, (x, key, x[:, :, :num_special]), (stacks, places, rows))
            return WindowTokens(key[:, : len(sizes.key_layers)], joined(last, x[:, :, :num_special]))

        if stacks is not None and (memory is None or isinstance(memory, FixedMemory)):
            return as_loop(x, memory), memory
        return one_by_one(x, memory)

    def _special_tokens(self, starts_sequence: jax.Array, frames: int, width: int) -> jax.Array:
        """Camera and register tokens [B, K, 5, C]: copy 0 for the sequence's first frame, copy 1 for others."""
        initial = normal(self.config.aggregator.token_scale)
        camera = self.param("camera_token", initial, (1, 2, 1, width))
        shape = (1, 2, self.config.aggregator.num_registers, width)
        register = self.param("register_token", initial, shape)
        copies = jnp.concatenate([camera, register], axis=2)[0]
        is_first = starts_sequence[:, None] & (jnp.arange(frames) == 0)
        return jnp.where(is_first[..., None, None], copies[0], copies[1])
