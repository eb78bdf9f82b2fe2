"""Overlapping windows: index arithmetic, the state that one window hands to the next, and the loop over them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from logvggt_jax.config import ModelConfig
from logvggt_jax.model.aggregator import Aggregator, WindowTokens
from logvggt_jax.model.checks import check_images, check_masks, checked_mask
from logvggt_jax.model.cross_window import CrossWindowMemory
from logvggt_jax.model.dinov2 import DinoV2
from logvggt_jax.model.dpt_head import DPTHead, depth_activation, point_activation
from logvggt_jax.model.layers import with_special
from logvggt_jax.model.masks import seen_patches, without_masked, zero_where_masked
from logvggt_jax.model.padding import with_places
from logvggt_jax.model.parameters import Variables, run
from logvggt_jax.types import WindowOutput

# Pixels that a dense head takes at once, about 8 frames of 518 x 518: its maps are the model's largest.
_DENSE_PIXELS = 8 * 518 * 518


@struct.dataclass
class WindowState:
    """All that a stream carries from window to window; its size does not depend on the sequence.

    F = K − s frames overlap. They are the last F of the window before and the first F of the window to come.

    Attributes:
      patch_tokens: [B, F, h * w, C] float32, the overlap frames as the encoder left them.
      key_tokens: [B, key layers, F, P, 2C] compute dtype, their key-layer outputs in the last window: the depth
        head's input when they become final, and, one half of the channels, the cache of cross-window attention.
      special_tokens: [B, F, 5, 2C] float32, their camera and register tokens in the last window.
      frame_mask: bool [B, F], False for padding.
      step: int32 [B], windows done.
      image_size: (H, W), static.
      masks: bool [B, F, H, W], see `masks.py`; None for a stream without masks.
    """

    patch_tokens: jax.Array
    key_tokens: jax.Array
    special_tokens: jax.Array
    frame_mask: jax.Array
    step: jax.Array
    image_size: tuple[int, int] = struct.field(pytree_node=False)
    masks: jax.Array | None = None


def num_windows(num_frames: int, size: int, stride: int) -> int:
    """Windows that cover `num_frames` frames; window i holds frames i·stride … i·stride + size − 1."""
    return 1 if num_frames <= size else -(-(num_frames - size) // stride) + 1


@dataclasses.dataclass(frozen=True)
class Windows:
    """Encoder, aggregator and dense heads over K frames at a time; pure functions of parameters and arrays.

    `start`, `step` and `finish` take a stream group by group, `scan` a whole sequence at once, with the same step.
    With `remat` layers and dense heads keep their inputs alone for the backward pass.
    """

    config: ModelConfig
    remat: bool = False

    # A stream.

    def start(
        self,
        variables: Variables,
        frames: jax.Array,
        frame_mask: jax.Array | None = None,
        masks: jax.Array | None = None,
    ) -> WindowState:
        """The state of a stream before its first window.

        Args:
          variables: {"params": …}.
          frames: the first K − s frames [B, K − s, H, W, 3]; fewer are padded and masked.
          frame_mask: bool [B, K − s], False for padding.
          masks: bool [B, K − s, H, W], True for pixels that count, see `masks.py`; None for a stream without masks.
        """
        config, overlap = self.config, self.overlap
        frame_mask = self._checked_group(frames, frame_mask, overlap, "start")
        batch, image_size = frames.shape[0], _image_size(frames)
        width, special = config.encoder.embed_dim, config.aggregator.num_special
        check_masks(frames, masks)
        patch_tokens = self.encode(variables, frames, masks)
        tokens = special + patch_tokens.shape[2]
        key_shape = (batch, len(config.aggregator.key_layers), overlap, tokens, 2 * width)
        return WindowState(
            patch_tokens=patch_tokens,
            key_tokens=jnp.zeros(key_shape, config.dtype),
            special_tokens=jnp.zeros((batch, overlap, special, 2 * width), jnp.float32),
            frame_mask=frame_mask,
            image_size=image_size,
            step=jnp.zeros((batch,), jnp.int32),
            masks=masks,
        )

    def step(
        self,
        variables: Variables,
        state: WindowState,
        frames: jax.Array,
        frame_mask: jax.Array | None = None,
        masks: jax.Array | None = None,
    ) -> tuple[WindowState, WindowOutput]:
        """Runs the window that s new frames complete; its s oldest frames become final.

        Args:
          variables: {"params": …}.
          state: from `start` or the step before; may be donated.
          frames: s new frames [B, s, H, W, 3]; a short tail is padded and masked.
          frame_mask: bool [B, s], False for padding. An item whose new frames are all padding has ended: it only
            hands out what it still holds. None says that all frames are real, those that the state holds as well:
            attention then knows no padding, which is the faster program.
          masks: bool [B, s, H, W], True for pixels that count; None for a stream that has been started without masks.
        """
        stride, padded = self.config.windows.stride, frame_mask is not None
        frame_mask = self._checked_group(frames, frame_mask, stride, "step")
        image_size = _image_size(frames)
        if (len(state.step), *state.image_size) != (len(frames), *image_size):
            raise ValueError(
                f"step continues a stream of {len(state.step)} x {state.image_size} images (batch, height and width), "
                f"got {len(frames)} x {image_size}; start a new stream for other shapes"
            )
        check_masks(frames, masks)
        if (masks is None) != (state.masks is None):
            raise ValueError(
                "a stream has masks for all frames or for none: give them to start and to every step, all True for "
                "frames without"
            )
        patch_tokens = jnp.concatenate([state.patch_tokens, self.encode(variables, frames, masks)], axis=1)
        window_mask = jnp.concatenate([state.frame_mask, frame_mask], axis=1)
        if masks is not None and state.masks is not None:
            masks = jnp.concatenate([state.masks, masks], axis=1)
        window = self.attend(variables, state, patch_tokens, window_mask.sum(1) if padded else None, masks)
        key_tokens, special_tokens = window
        if padded:
            # An item that has ended shifts its held frames out instead.
            active = (state.step == 0) | frame_mask.any(1)
            key_tokens = _select(active, key_tokens, with_places(state.key_tokens, stride, axis=2))
            special_tokens = _select(active, special_tokens, with_places(state.special_tokens, stride, axis=1))
            window_mask = _select(active, window_mask, with_places(state.frame_mask, stride, axis=1))
            if masks is not None and state.masks is not None:
                masks = _select(active, masks, with_places(state.masks, stride, axis=1))
        out = self.decode_dense(
            variables,
            WindowTokens(key_tokens[:, :, :stride], special_tokens[:, :stride]),
            window_mask[:, :stride],
            image_size,
            None if masks is None else masks[:, :stride],
        )
        state = WindowState(
            patch_tokens=patch_tokens[:, stride:],
            key_tokens=key_tokens[:, :, stride:],
            special_tokens=special_tokens[:, stride:],
            frame_mask=window_mask[:, stride:],
            image_size=image_size,
            step=state.step + 1,
            masks=None if masks is None else masks[:, stride:],
        )
        return state, out

    def finish(self, variables: Variables, state: WindowState) -> WindowOutput:
        """The K − s frames that the last window still holds; where there was no window yet, none of them counts."""
        held = WindowTokens(state.key_tokens, state.special_tokens)
        frame_mask = state.frame_mask & (state.step > 0)[:, None]
        return self.decode_dense(variables, held, frame_mask, state.image_size, state.masks)

    # A whole sequence.

    def scan(
        self,
        variables: Variables,
        images: jax.Array,
        frame_mask: jax.Array | None = None,
        masks: jax.Array | None = None,
    ) -> WindowOutput:
        """All windows of sequences [B, T, H, W, 3] as one scan over `step`.

        Args:
          variables: {"params": …}.
          images: [B, T, H, W, 3].
          frame_mask: bool [B, T]; None for all frames.
          masks: bool [B, T, H, W], True for pixels that count; None for all pixels.
        """
        check_images(images, self.config.encoder.patch_size)
        check_masks(images, masks)
        frame_mask = None if frame_mask is None else checked_mask(images, frame_mask)
        num_frames, stride, overlap = images.shape[1], self.config.windows.stride, self.overlap
        windows = num_windows(num_frames, self.config.windows.size, stride)
        padded = windows * stride + overlap
        all_real = frame_mask is None and padded == num_frames

        def frames_from(first: jax.Array | int, count: int) -> tuple[jax.Array, jax.Array | None, jax.Array | None]:
            # A short tail repeats the last frame, masked, instead of padding a copy of all images.
            index = first + jnp.arange(count)
            clipped = jnp.minimum(index, num_frames - 1)
            frames = jnp.take(images, clipped, axis=1)
            of_frames = None if masks is None else jnp.take(masks, clipped, axis=1)
            if all_real:
                return frames, None, of_frames
            mask = jnp.broadcast_to(index < num_frames, frames.shape[:2])
            mask = mask if frame_mask is None else mask & jnp.take(frame_mask, clipped, axis=1)
            return frames, mask, of_frames

        def advance(state: WindowState, window: jax.Array) -> tuple[WindowState, WindowOutput]:
            return self.step(variables, state, *frames_from(window * stride + overlap, stride))

        state = self.start(variables, *frames_from(0, overlap))
        # Outputs live in buffers that the scan updates in place: stacked ones would be copied to put B first.
        one_step = jax.eval_shape(advance, state, jnp.int32(0))[1]
        buffers = jax.tree.map(lambda x: jnp.zeros((x.shape[0], padded, *x.shape[2:]), x.dtype), one_step)

        def write(buffers: WindowOutput, out: WindowOutput, first: jax.Array | int) -> WindowOutput:
            return jax.tree.map(
                lambda buffer, x: jax.lax.dynamic_update_slice_in_dim(buffer, x, first, axis=1), buffers, out
            )

        def body(
            carry: tuple[WindowState, WindowOutput, jax.Array], _: None
        ) -> tuple[tuple[WindowState, WindowOutput, jax.Array], None]:
            state, buffers, window = carry
            state, out = advance(state, window)
            return (state, write(buffers, out, window * stride), window + 1), None

        (state, buffers, _), _ = jax.lax.scan(body, (state, buffers, jnp.int32(0)), length=windows)
        buffers = write(buffers, self.finish(variables, state), windows * stride)
        return jax.tree.map(lambda x: x[:, :num_frames], buffers)

    # The parts of a step.

    def encode(self, variables: Variables, images: jax.Array, masks: jax.Array | None = None) -> jax.Array:
        """Patch tokens [B, n, h * w, C] float32 of images [B, n, H, W, 3]; frames are independent. Nothing of what
        `masks`, bool [B, n, H, W], drops is in them."""
        params = variables["params"]["encoder"]
        if self.config.encoder.frozen:
            # At the source: nothing of the encoder's pass is then kept for a backward pass.
            params = jax.lax.stop_gradient(params)
        pixels = jnp.asarray(images, jnp.float32) / (255.0 if images.dtype == jnp.uint8 else 1.0)
        pixels, seen = without_masked(pixels, masks), seen_patches(masks, self.config.encoder.patch_size)
        of_each = None if seen is None else seen.reshape(-1, seen.shape[-1])
        tokens = run(self.encoder, params, pixels.reshape(-1, *images.shape[2:]), of_each)
        return tokens.reshape(*images.shape[:2], *tokens.shape[1:])

    def attend(
        self,
        variables: Variables,
        state: WindowState,
        patch_tokens: jax.Array,
        lengths: jax.Array | None = None,
        masks: jax.Array | None = None,
    ) -> WindowTokens:
        """All attention blocks over one window.

        Args:
          variables: {"params": …}.
          state: of the stream before the window, whose cache the key layers see.
          patch_tokens: [B, K, h * w, C] of the window's frames.
          lengths: int32 [B], how many of the frames are real, always the first ones; None for all.
          masks: bool [B, K, H, W] of the frames, where the state has masks.
        """
        is_first, grid = state.step == 0, self.grid(state.image_size)
        params, seen = variables["params"]["aggregator"], seen_patches(masks, self.config.encoder.patch_size)
        memory = self._memory(state)
        tokens, _ = run(self.aggregator, params, patch_tokens, lengths, is_first, memory, grid=grid, seen=seen)
        return tokens

    def decode_dense(
        self,
        variables: Variables,
        tokens: WindowTokens,
        frame_mask: jax.Array,
        image_size: tuple[int, int],
        masks: jax.Array | None = None,
    ) -> WindowOutput:
        """Dense heads over the tokens of n frames, which are independent.

        Args:
          variables: {"params": …}.
          tokens: key [B, key layers, n, P, 2C], special [B, n, 5, 2C].
          frame_mask: bool [B, n], handed on.
          image_size: (H, W).
          masks: bool [B, n, H, W], False for pixels whose outputs are 0; None for none.
        """
        params, grid = variables["params"], self.grid(image_size)
        batch, num_levels, count = tokens.key.shape[:3]
        patches = tokens.key[..., self.config.aggregator.num_special :, :]
        levels = [patches[:, i].reshape(batch * count, *patches.shape[3:]) for i in range(num_levels)]

        def dense(head: DPTHead, name: str) -> jax.Array:
            def frames(levels: list[jax.Array]) -> jax.Array:
                return run(head, params[name], levels, grid=grid, image_size=image_size)

            if self.remat:
                frames = jax.checkpoint(frames, prevent_cse=False)
            raw = _in_groups(frames, levels, max(1, _DENSE_PIXELS // math.prod(image_size)))
            return raw.reshape(batch, count, *raw.shape[1:])

        maps = depth_activation(dense(self.depth_head, "depth_head"))
        depth, depth_confidence = (zero_where_masked(x, masks) for x in maps)
        points = points_confidence = None
        if self.config.point_head is not None:
            maps = point_activation(dense(self.point_head, "point_head"))
            points, points_confidence = (zero_where_masked(x, masks) for x in maps)
        return WindowOutput(
            depth=depth,
            depth_confidence=depth_confidence,
            camera_tokens=tokens.special[:, :, 0],
            register_tokens=tokens.special[:, :, 1:],
            frame_mask=frame_mask,
            points=points,
            points_confidence=points_confidence,
        )

    # Modules and sizes.

    @property
    def encoder(self) -> DinoV2:
        """From images to patch tokens."""
        return DinoV2(self.config.encoder, self.config.dtype, self.config.attention, self.remat)

    @property
    def aggregator(self) -> Aggregator:
        """From patch tokens of a window to its tokens, frame and global blocks in turns."""
        return Aggregator(self.config, self.remat)

    @property
    def depth_head(self) -> DPTHead:
        """From tokens of the key layers to depth and its confidence."""
        return DPTHead(self.config.depth_head, 2, self.config.dtype)

    @property
    def point_head(self) -> DPTHead:
        """Likewise to points and theirs; ValueError for a model without it."""
        if self.config.point_head is None:
            raise ValueError("this model has no point head: set ModelConfig.point_head")
        return DPTHead(self.config.point_head, 4, self.config.dtype)

    @property
    def overlap(self) -> int:
        """F = K − s, the frames that neighbouring windows share."""
        return self.config.windows.size - self.config.windows.stride

    def grid(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """(h, w) patches of images of (H, W) pixels."""
        patch = self.config.encoder.patch_size
        return image_size[0] // patch, image_size[1] // patch

    def _memory(self, state: WindowState) -> CrossWindowMemory:
        """What the key layers see of the window before; before the first window nothing."""
        windows, width = self.config.windows, self.config.encoder.embed_dim
        seen = seen_patches(state.masks, self.config.encoder.patch_size)
        # Key tokens hold the frame block's output, which is the global block's input, before that block's output.
        half = slice(width, None) if windows.cache == "output" else slice(None, width)
        return CrossWindowMemory(
            state.key_tokens[..., half],
            jnp.where(state.step == 0, 0, state.frame_mask.sum(1)),
            self.config.aggregator.key_layers if windows.cross_window else (),
            None if seen is None else with_special(seen, self.config.aggregator.num_special),
        )

    def _checked_group(self, frames: jax.Array, mask: jax.Array | None, count: int, name: str) -> jax.Array:
        """The mask bool [B, count] of a call of `start` or `step`, after a check of both."""
        check_images(frames, self.config.encoder.patch_size, f"frames of {name}")
        if frames.shape[1] != count:
            raise ValueError(
                f"{name} takes {count} frames [B, {count}, H, W, 3], got {frames.shape[1]}; pad them and pass "
                "frame_mask"
            )
        return checked_mask(frames, mask)


def _in_groups(function: Callable[[Any], jax.Array], inputs: Any, at_most: int) -> jax.Array:
    """`function` of arrays [N, ...] that it treats item by item, at most so many items at a time."""
    count = len(jax.tree.leaves(inputs)[0])
    groups = -(-count // at_most)
    if groups == 1:
        return function(inputs)
    size = -(-count // groups)

    def split(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, [(0, groups * size - count), *[(0, 0)] * (x.ndim - 1)])
        return x.reshape(groups, size, *x.shape[1:])

    out = jax.lax.map(function, jax.tree.map(split, inputs))
    return out.reshape(groups * size, *out.shape[2:])[:count]


def _image_size(images: jax.Array) -> tuple[int, int]:
    return images.shape[2], images.shape[3]


def _select(active: jax.Array, when_active: jax.Array, otherwise: jax.Array) -> jax.Array:
    """Chooses per batch item; `active` bool [B]."""
    return jnp.where(active.reshape(-1, *(1,) * (when_active.ndim - 1)), when_active, otherwise)
