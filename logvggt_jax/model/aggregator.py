"""Alternating frame and global attention over the frames of one window."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.initializers import normal
from logvggt_jax.model.layers import Block, with_special
from logvggt_jax.model.memory import FixedMemory, LayerMemory, Memory
from logvggt_jax.model.parameters import given, run
from logvggt_jax.model.rope import rope_table
from logvggt_jax.model.shape_check import ShapeCheck

BlockFunction = Callable[..., tuple[jax.Array, LayerMemory | None]]
# Of layers that hand them out, the outputs [B, K, P, C] of the frame block and of the global block.
Outputs = list[tuple[jax.Array, jax.Array]]


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

    Layers run one after the other. Where their parameters come stacked (see `parameters.stack_layers`) neighbours of
    one kind run as a loop, whose body is compiled once: those between two key layers, and key layers that follow one
    another. With a memory that the layers change they run one by one. With `remat` a stacked layer keeps nothing but
    its input for the backward pass.
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
        num_special = 1 + sizes.num_registers
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
        outlets = {*sizes.key_layers, sizes.depth - 1}

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

        def single(layer: int, x: jax.Array, memory: Memory | None) -> tuple[jax.Array, Outputs, Memory | None]:
            """The layer's output, what it hands out, and the memory after it."""
            read = None if memory is None else memory.at(layer)
            names = f"frame_block_{layer}", f"global_block_{layer}"
            if stacks is not None:
                frame_out, x, left = by_parameters(jax.tree.map(lambda stack: stack[layer], stacks), x, read)
            elif given(self, names[0]):
                frame_out, x, left = by_parameters(tuple(self.get_variable("params", name) for name in names), x, read)
            else:
                frame_out, x, left = one_layer(block(name=names[0]), block(name=names[1]), x, read)
            if memory is not None and left is not None:
                memory = memory.updated(layer, left)
            return x, [(frame_out, x)], memory

        def loop(layers: range, x: jax.Array, memory: Memory | None) -> tuple[jax.Array, Outputs]:
            """The last layer's output, and what each hands out, if they do."""
            some = jax.tree.map(lambda stack: stack[layers.start : layers.stop], stacks)
            reads = [None if memory is None else memory.at(layer) for layer in layers]

            def body(x: jax.Array, layer: tuple[Any, LayerMemory | None]) -> tuple[jax.Array, Any]:
                frame_out, x, _ = by_parameters(layer[0], x, layer[1])
                return x, (frame_out, x) if layers[0] in outlets else None

            x, made = jax.lax.scan(body, x, (some, jax.tree.map(lambda *read: jnp.stack(read), *reads)))
            return x, [] if made is None else list(zip(*made, strict=True))

        key_tokens: list[jax.Array] = []
        made: Outputs = []
        for layers in _alike(sizes.depth, outlets, memory, stacked=stacks is not None):
            if len(layers) == 1:
                x, made, memory = single(layers[0], x, memory)
            else:
                x, made = loop(layers, x, memory)
            for layer, outputs in zip(layers, made, strict=False):
                if layer in sizes.key_layers:
                    key_tokens.append(jnp.concatenate(outputs, axis=-1).astype(config.dtype))
        last = jnp.concatenate([tokens[:, :, :num_special] for tokens in made[-1]], axis=-1)
        return WindowTokens(jnp.stack(key_tokens, axis=1), last), memory

    def _special_tokens(self, starts_sequence: jax.Array, frames: int, width: int) -> jax.Array:
        """Camera and register tokens [B, K, 5, C]: copy 0 for the sequence's first frame, copy 1 for others."""
        initial = normal(self.config.aggregator.token_scale)
        camera = self.param("camera_token", initial, (1, 2, 1, width))
        shape = (1, 2, self.config.aggregator.num_registers, width)
        register = self.param("register_token", initial, shape)
        copies = jnp.concatenate([camera, register], axis=2)[0]
        is_first = starts_sequence[:, None] & (jnp.arange(frames) == 0)
        return jnp.where(is_first[..., None, None], copies[0], copies[1])


def _alike(depth: int, outlets: set[int], memory: Memory | None, *, stacked: bool) -> Iterator[range]:
    """The layers in runs that can be one loop: all or none of a run hand out what they make, all or none read the
    memory, and if they do it is one that stays as it is. Layers that are not stacked run one by one."""

    def kind(layer: int) -> Any:
        if not stacked or not (memory is None or isinstance(memory, FixedMemory)):
            return layer
        return layer in outlets, memory is not None and memory.at(layer) is not None

    for _, alike in itertools.groupby(range(depth), kind):
        layers = list(alike)
        yield range(layers[0], layers[-1] + 1)
