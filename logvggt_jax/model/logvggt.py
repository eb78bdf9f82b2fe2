"""LoG-VGGT: encoder, windows, heads and refinement wired into pure functions of parameters and arrays."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from logvggt_jax.config import ModelConfig
from logvggt_jax.geometry.pose_encoding import decode_poses
from logvggt_jax.model import refinement
from logvggt_jax.model.aggregator import Aggregator
from logvggt_jax.model.camera_head import CameraHead
from logvggt_jax.model.dinov2 import DinoV2
from logvggt_jax.model.dpt_head import DPTHead, depth_activation, point_activation
from logvggt_jax.model.gccr import GCCR, RegisterKeys
from logvggt_jax.model.windows import WindowState, num_windows
from logvggt_jax.types import Predictions, WindowOutput

Variables = dict[str, Any]

_PATCH_TOKENS = "patch_tokens"
# Pixels that a dense head takes at once, about 8 frames of 518 x 518: its maps are the model's largest.
_DENSE_PIXELS = 8 * 518 * 518


@dataclasses.dataclass(frozen=True)
class LogVGGT:
    """The model: hashable, hence static under jit; every method is pure.

        model = LogVGGT(ModelConfig())
        variables = model.init(jax.random.key(0), images)
        predictions = jax.jit(model.apply)(variables, images)

    `start`, `step`, `finish` and `refine` give `apply`'s numbers for a stream, group by group of frames.
    Images are RGB [B, T, H, W, 3], float32 in [0, 1] or uint8, H and W multiples of the patch size. Methods raise
    ValueError for another shape or dtype.
    """

    config: ModelConfig = ModelConfig()

    # Parameters.

    def init(self, key: jax.Array, images: jax.Array) -> Variables:
        """Random parameters {"params": …}, float32; `images` [B, T, H, W, 3] are checked, not read.

        The modules see abstract inputs: eager generators for the parameters compile once a shape, where a
        jitted program would inline one for each parameter.
        """
        self._check_images(images, "images")
        config, image_size = self.config, _image_size(images)
        grid = self._grid(image_size)
        width, patches = config.encoder.embed_dim, grid[0] * grid[1]
        registers = config.aggregator.num_registers
        keys = iter(jax.random.split(key, 6))

        def floats(*shape: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, jnp.float32)

        mask, first = jax.ShapeDtypeStruct((1, 1), bool), jax.ShapeDtypeStruct((1,), bool)
        cached = floats(1, len(config.aggregator.key_layers), 1, patches + 1 + registers, width)
        camera, levels = floats(1, 1, 2 * width), [floats(1, patches, 2 * width)] * 4
        dense: Any = {"grid": grid, "image_size": image_size}
        modules = {
            "encoder": self._encoder.lazy_init(next(keys), floats(1, *image_size, 3)),
            "aggregator": self._aggregator.lazy_init(
                next(keys), floats(1, 1, patches, width), mask, cached, mask, first, grid=grid
            ),
            "camera_head": self._camera_head.lazy_init(next(keys), camera, mask),
            "depth_head": self._depth_head.lazy_init(next(keys), levels, **dense),
            "gccr": self._gccr.lazy_init(next(keys), camera, floats(1, 1, registers, 2 * width), mask),
        }
        if config.point_head is not None:
            modules["point_head"] = self._point_head.lazy_init(next(keys), levels, **dense)
        return {"params": {name: variables["params"] for name, variables in modules.items()}}

    # Whole sequences.

    def apply(
        self,
        variables: Variables,
        images: jax.Array,
        frame_mask: jax.Array | None = None,
        *,
        remat: bool = False,
    ) -> Predictions:
        """Cameras, depth and tokens of sequences of any length T >= 1.

        Args:
          variables: {"params": …}.
          images: [B, T, H, W, 3].
          frame_mask: bool [B, T], True … True False … False for sequences of unequal length; None for full ones.
            Entries of padded frames mean nothing.
          remat: recompute each window in the backward pass instead of storing its activations; a frame's patch
            tokens are stored.
        """
        frame_mask = self._mask(images, frame_mask)
        out = self.run_windows(variables, images, frame_mask, remat=remat)
        pose_encodings = self.refine_sequence(variables, out.camera_tokens, out.register_tokens, frame_mask)
        pose_encoding = pose_encodings[:, :, -1]
        extrinsics, intrinsics = decode_poses(pose_encoding, _image_size(images))
        return Predictions(
            pose_encoding=pose_encoding,
            pose_encodings=pose_encodings,
            extrinsics=extrinsics,
            intrinsics=intrinsics,
            depth=out.depth,
            depth_confidence=out.depth_confidence,
            camera_tokens=out.camera_tokens,
            register_tokens=out.register_tokens,
            points=out.points,
            points_confidence=out.points_confidence,
        )

    def run_windows(
        self,
        variables: Variables,
        images: jax.Array,
        frame_mask: jax.Array | None = None,
        *,
        remat: bool = False,
    ) -> WindowOutput:
        """All windows of sequences [B, T, H, W, 3] as one scan; the outputs of `apply` short of the poses."""
        self._mask(images, frame_mask)
        num_frames, stride, overlap = images.shape[1], self.config.windows.stride, self._overlap

        def frames_from(first: jax.Array | int, count: int) -> tuple[jax.Array, jax.Array]:
            # A short tail repeats the last frame, masked, instead of padding a copy of all images.
            index = first + jnp.arange(count)
            clipped = jnp.minimum(index, num_frames - 1)
            frames = jnp.take(images, clipped, axis=1)
            mask = jnp.broadcast_to(index < num_frames, frames.shape[:2])
            return frames, mask if frame_mask is None else mask & jnp.take(frame_mask, clipped, axis=1)

        def advance(state: WindowState, window: jax.Array) -> tuple[WindowState, WindowOutput]:
            frames, mask = frames_from(window * stride + overlap, stride)
            return self.step(variables, state, frames, mask)

        if remat:
            # All but the encoder's result, without which a frozen encoder would run twice.
            keep = jax.checkpoint_policies.save_only_these_names(_PATCH_TOKENS)
            advance = jax.checkpoint(advance, prevent_cse=False, policy=keep)

        windows = num_windows(num_frames, self.config.windows.size, stride)
        state = self.start(variables, *frames_from(0, overlap))
        # Outputs live in buffers that the scan updates in place: stacked ones would be copied to put B first.
        padded = windows * stride + overlap
        one_step = jax.eval_shape(advance, state, jnp.int32(0))[1]
        buffers = jax.tree.map(
            lambda x: jnp.zeros_like(state.patch_tokens, shape=(x.shape[0], padded, *x.shape[2:]), dtype=x.dtype),
            one_step,
        )

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

    # Streams.

    def start(self, variables: Variables, frames: jax.Array, frame_mask: jax.Array | None = None) -> WindowState:
        """The state of a stream before its first window.

        Args:
          variables: {"params": …}.
          frames: the first K − s frames [B, K − s, H, W, 3]; fewer are padded and masked.
          frame_mask: bool [B, K − s], False for padding.
        """
        frame_mask = self._mask(frames, frame_mask, count=self._overlap, name="start")
        config, batch, image_size = self.config, frames.shape[0], _image_size(frames)
        grid = self._grid(image_size)
        width, registers = config.encoder.embed_dim, config.aggregator.num_registers
        patch_tokens = self.encode(variables, frames)
        tokens = grid[0] * grid[1] + 1 + registers

        def zeros(shape: tuple[int, ...], dtype: Any) -> jax.Array:
            # "Like" the tokens, so that under shard_map the scan's state varies over devices from the start.
            return jnp.zeros_like(patch_tokens, shape=shape, dtype=dtype)

        key_shape = (batch, len(config.aggregator.key_layers), self._overlap, tokens, 2 * width)
        special_shape = (batch, self._overlap, 1 + registers, 2 * width)
        return WindowState(
            patch_tokens=patch_tokens,
            key_tokens=zeros(key_shape, config.dtype),
            special_tokens=zeros(special_shape, jnp.float32),
            frame_mask=frame_mask,
            image_size=image_size,
            step=zeros((batch,), jnp.int32),
        )

    def step(
        self,
        variables: Variables,
        state: WindowState,
        frames: jax.Array,
        frame_mask: jax.Array | None = None,
    ) -> tuple[WindowState, WindowOutput]:
        """Runs the window that s new frames complete; its s oldest frames become final.

        Args:
          variables: {"params": …}.
          state: from `start` or the step before; may be donated.
          frames: s new frames [B, s, H, W, 3]; a short tail is padded and masked.
          frame_mask: bool [B, s], False for padding. An item whose new frames are all padding has ended: it only
            hands out what it still holds.
        """
        stride = self.config.windows.stride
        frame_mask = self._mask(frames, frame_mask, count=stride, name="step")
        image_size = _image_size(frames)
        if (len(state.step), *state.image_size) != (len(frames), *image_size):
            raise ValueError(
                f"step continues a stream of {len(state.step)} x {state.image_size} images (batch, height and width), "
                f"got {len(frames)} x {image_size}; start a new stream for other shapes"
            )
        fresh = self.encode(variables, frames)
        patch_tokens = jnp.concatenate([state.patch_tokens, fresh], axis=1)
        window_mask = jnp.concatenate([state.frame_mask, frame_mask], axis=1)
        is_first = state.step == 0
        key_tokens, special_tokens = self.attend_window(variables, state, patch_tokens, window_mask)
        # An item that has ended shifts its held frames out instead.
        active = is_first | frame_mask.any(1)
        key_tokens = _select(active, key_tokens, _shift_in(state.key_tokens, stride, axis=2))
        special_tokens = _select(active, special_tokens, _shift_in(state.special_tokens, stride, axis=1))
        window_mask = _select(active, window_mask, _shift_in(state.frame_mask, stride, axis=1))
        out = self.decode_dense(
            variables,
            key_tokens[:, :, :stride],
            special_tokens[:, :stride],
            window_mask[:, :stride],
            image_size,
        )
        state = WindowState(
            patch_tokens=patch_tokens[:, stride:],
            key_tokens=key_tokens[:, :, stride:],
            special_tokens=special_tokens[:, stride:],
            frame_mask=window_mask[:, stride:],
            image_size=image_size,
            step=state.step + 1,
        )
        return state, out

    def finish(self, variables: Variables, state: WindowState) -> WindowOutput:
        """The K − s frames that the last window still holds."""
        return self.decode_dense(variables, state.key_tokens, state.special_tokens, state.frame_mask, state.image_size)

    def refine(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        register_tokens: jax.Array,
        camera_mask: jax.Array,
        register_mask: jax.Array,
    ) -> jax.Array:
        """GCCR and camera head over the tokens at hand.

        Args:
          variables: {"params": …}.
          camera_tokens: [B, N, 2C].
          register_tokens: [B, M, 4, 2C].
          camera_mask: bool [B, N], False for padding.
          register_mask: bool [B, M], False for padding.

        Returns:
          Pose encodings [B, N, R, 9] of all rounds, world-to-camera in the first camera's frame.
        """
        refined = self.refine_tokens(variables, camera_tokens, register_tokens, register_mask)
        return self.decode_cameras(variables, refined, camera_mask)

    def refine_tokens(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        register_tokens: jax.Array,
        register_mask: jax.Array,
    ) -> jax.Array:
        """GCCR alone: [B, N, 2C], [B, M, 4, 2C], bool [B, M] -> [B, N, 2C]; the identity when disabled."""
        if not self.config.refinement.enabled:
            return camera_tokens
        width, registers = 2 * self.config.encoder.embed_dim, self.config.aggregator.num_registers
        _check("camera_tokens", camera_tokens, (None, None, width), jnp.floating)
        _check("register_tokens", register_tokens, (len(camera_tokens), None, registers, width), jnp.floating)
        _check("register_mask", register_mask, register_tokens.shape[:2], jnp.bool_)
        params = variables["params"]["gccr"]
        return _run(self._gccr, params, camera_tokens, register_tokens, register_mask)

    def project_registers(self, variables: Variables, register_tokens: jax.Array) -> RegisterKeys:
        """GCCR's keys and values of register tokens [B, M, 4, 2C], frame by frame.

        A stream that refines often projects each frame once; over again for every refinement, the cost a frame
        would grow with the sequence.
        """
        width, registers = 2 * self.config.encoder.embed_dim, self.config.aggregator.num_registers
        _check("register_tokens", register_tokens, (None, None, registers, width), jnp.floating)
        return _run(self._gccr, variables["params"]["gccr"], register_tokens, method=GCCR.project)

    def attend_registers(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        registers: RegisterKeys,
        register_mask: jax.Array,
    ) -> jax.Array:
        """GCCR after `project_registers`: [B, N, 2C], M frames' keys and values, bool [B, M] -> [B, N, 2C]."""
        width = 2 * self.config.encoder.embed_dim
        _check("camera_tokens", camera_tokens, (len(registers.key), None, width), jnp.floating)
        _check("register_mask", register_mask, registers.key.shape[:2], jnp.bool_)
        params = variables["params"]["gccr"]
        return _run(self._gccr, params, camera_tokens, registers, register_mask, method=GCCR.attend)

    def decode_cameras(self, variables: Variables, camera_tokens: jax.Array, camera_mask: jax.Array) -> jax.Array:
        """Camera head alone: refined tokens [B, N, 2C], bool [B, N] -> pose encodings [B, N, R, 9]."""
        _check("camera_tokens", camera_tokens, (None, None, 2 * self.config.encoder.embed_dim), jnp.floating)
        _check("camera_mask", camera_mask, camera_tokens.shape[:2], jnp.bool_)
        return _run(self._camera_head, variables["params"]["camera_head"], camera_tokens, camera_mask)

    def decode_group(
        self,
        variables: Variables,
        refined_tokens: jax.Array,
        lengths: jax.Array,
        start: jax.Array | int,
        stop: jax.Array | int,
    ) -> jax.Array:
        """Pose encodings [B, s, R, 9] of one stride of frames from `start`, the trunk seeing frame 0 and
        `refinement.context` frames up to `stop`; see `refinement.decode_group`."""
        context = self.config.refinement.context
        if context is None:
            raise ValueError("decode_group needs refinement.context; without it use decode_cameras")
        return refinement.decode_group(
            functools.partial(self.decode_cameras, variables),
            refined_tokens,
            lengths,
            start,
            stop,
            group=self.config.windows.stride,
            context=context,
        )

    def refine_sequence(
        self,
        variables: Variables,
        camera_tokens: jax.Array,
        register_tokens: jax.Array,
        frame_mask: jax.Array,
    ) -> jax.Array:
        """Pose encodings [B, T, R, 9] of whole sequences in the configured mode: full, periodic or online."""
        settings = self.config.refinement
        registers = self.project_registers(variables, register_tokens) if settings.enabled else None

        def refine_tokens(tokens: jax.Array, register_mask: jax.Array) -> jax.Array:
            return tokens if registers is None else self.attend_registers(variables, tokens, registers, register_mask)

        return refinement.refine_sequence(
            refine_tokens,
            functools.partial(self.decode_cameras, variables),
            camera_tokens,
            frame_mask,
            period=settings.period,
            context=settings.context,
            group=self.config.windows.stride,
        )

    # Parts of a step.

    def encode(self, variables: Variables, images: jax.Array) -> jax.Array:
        """Patch tokens [B, n, h * w, C] float32 of images [B, n, H, W, 3]; frames are independent."""
        params = variables["params"]["encoder"]
        if self.config.encoder.frozen:
            # At the source: nothing of the encoder's pass is then kept for a backward pass.
            params = jax.lax.stop_gradient(params)
        pixels = jnp.asarray(images, jnp.float32) / (255.0 if images.dtype == jnp.uint8 else 1.0)
        tokens = _run(self._encoder, params, pixels.reshape(-1, *images.shape[2:]))
        return checkpoint_name(tokens.reshape(*images.shape[:2], *tokens.shape[1:]), _PATCH_TOKENS)

    def attend_window(
        self, variables: Variables, state: WindowState, patch_tokens: jax.Array, window_mask: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """All attention blocks over one window.

        Args:
          variables: {"params": …}.
          state: of the stream before the window, whose cache the key layers see.
          patch_tokens: [B, K, h * w, C] of the window's frames.
          window_mask: bool [B, K], False for padding.

        Returns:
          Key-layer tokens [B, key layers, K, P, 2C] in the compute dtype; special tokens [B, K, 5, 2C] float32.
        """
        is_first = state.step == 0
        width = self.config.encoder.embed_dim
        halves = slice(width, None) if self.config.windows.cache == "output" else slice(None, width)
        return _run(
            self._aggregator,
            variables["params"]["aggregator"],
            patch_tokens,
            window_mask,
            state.key_tokens[..., halves],
            state.frame_mask & ~is_first[:, None],
            is_first,
            grid=self._grid(state.image_size),
        )

    def decode_dense(
        self,
        variables: Variables,
        key_tokens: jax.Array,
        special_tokens: jax.Array,
        frame_mask: jax.Array,
        image_size: tuple[int, int],
    ) -> WindowOutput:
        """Dense heads over key-layer tokens [B, key layers, n, P, 2C] of n frames, which are independent."""
        params, grid = variables["params"], self._grid(image_size)
        batch, num_levels, count = key_tokens.shape[:3]
        patches = key_tokens[..., 1 + self.config.aggregator.num_registers :, :]
        levels = [patches[:, i].reshape(batch * count, *patches.shape[3:]) for i in range(num_levels)]

        def dense(head: DPTHead, name: str) -> jax.Array:
            def frames(levels: list[jax.Array]) -> jax.Array:
                return _run(head, params[name], levels, grid=grid, image_size=image_size)

            raw = _in_groups(frames, levels, max(1, _DENSE_PIXELS // math.prod(image_size)))
            return raw.reshape(batch, count, *raw.shape[1:])

        depth, depth_confidence = depth_activation(dense(self._depth_head, "depth_head"))
        points = points_confidence = None
        if self.config.point_head is not None:
            points, points_confidence = point_activation(dense(self._point_head, "point_head"))
        return WindowOutput(
            depth=depth,
            depth_confidence=depth_confidence,
            camera_tokens=special_tokens[:, :, 0],
            register_tokens=special_tokens[:, :, 1:],
            frame_mask=frame_mask,
            points=points,
            points_confidence=points_confidence,
        )

    # Modules.

    @property
    def _encoder(self) -> DinoV2:
        return DinoV2(self.config.encoder, self.config.dtype, self.config.attention)

    @property
    def _aggregator(self) -> Aggregator:
        return Aggregator(self.config)

    @property
    def _camera_head(self) -> CameraHead:
        return CameraHead(self.config.camera_head, self.config.attention)

    @property
    def _depth_head(self) -> DPTHead:
        return DPTHead(self.config.depth_head, 2, self.config.dtype)

    @property
    def _point_head(self) -> DPTHead:
        if self.config.point_head is None:
            raise ValueError("this model has no point head: set ModelConfig.point_head")
        return DPTHead(self.config.point_head, 4, self.config.dtype)

    @property
    def _gccr(self) -> GCCR:
        width = 2 * self.config.encoder.embed_dim
        return GCCR(width, self.config.refinement.num_heads, self.config.dtype, self.config.attention)

    @property
    def _overlap(self) -> int:
        return self.config.windows.size - self.config.windows.stride

    def _grid(self, image_size: tuple[int, int]) -> tuple[int, int]:
        patch = self.config.encoder.patch_size
        return image_size[0] // patch, image_size[1] // patch

    def _check_images(self, images: jax.Array, name: str) -> None:
        patch = self.config.encoder.patch_size
        shape = tuple(images.shape)
        if len(shape) != 5 or shape[-1] != 3 or 0 in shape:
            raise ValueError(f"{name} must have shape [B, T, H, W, 3] with T >= 1, got {shape}")
        if shape[2] % patch or shape[3] % patch:
            raise ValueError(
                f"{name} have height {shape[2]} and width {shape[3]}, which must be multiples of {patch}; "
                "logvggt_jax.preprocess resizes frames of any size"
            )
        if images.dtype != jnp.uint8 and not jnp.issubdtype(images.dtype, jnp.floating):
            raise ValueError(f"{name} must be uint8 or floating point in [0, 1], got dtype {images.dtype}")

    def _mask(
        self, images: jax.Array, mask: jax.Array | None, *, count: int | None = None, name: str = "images"
    ) -> jax.Array:
        """The frame mask bool [B, T], after a check of images and mask."""
        self._check_images(images, name if count is None else f"frames of {name}")
        if count is not None and images.shape[1] != count:
            raise ValueError(
                f"{name} takes {count} frames [B, {count}, H, W, 3], got {images.shape[1]}; pad them and pass "
                "frame_mask"
            )
        # "Like" the images, so that under shard_map any mask varies over devices as they do.
        everything = jnp.ones_like(images, shape=images.shape[:2], dtype=bool)
        if mask is None:
            return everything
        _check("frame_mask", mask, images.shape[:2], jnp.bool_)
        return everything & mask


def _run(module: nn.Module, params: Any, *inputs: Any, **options: Any) -> Any:
    """A linen module as a pure function of its own parameters."""
    return module.apply({"params": params}, *inputs, **options)


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


def _check(name: str, array: jax.Array, shape: tuple[int | None, ...], kind: Any) -> None:
    """Raises ValueError unless an array has this shape (None: any size) and its dtype is of this kind."""
    found = tuple(array.shape)
    fits = len(found) == len(shape) and all(a in (b, None) for a, b in zip(shape, found, strict=True))
    if not fits or not jnp.issubdtype(array.dtype, kind):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        kind_name = "bool" if kind is jnp.bool_ else "floating point"
        raise ValueError(f"{name} must be {kind_name} [{wanted}], got {array.dtype} {list(found)}")


def _image_size(images: jax.Array) -> tuple[int, int]:
    return images.shape[2], images.shape[3]


def _shift_in(held: jax.Array, padding: int, *, axis: int) -> jax.Array:
    """`held` followed by `padding` empty frames."""
    return jnp.pad(held, [(0, padding if i == axis else 0) for i in range(held.ndim)])


def _select(active: jax.Array, when_active: jax.Array, otherwise: jax.Array) -> jax.Array:
    """Chooses per batch item; `active` bool [B]."""
    return jnp.where(active.reshape(-1, *(1,) * (when_active.ndim - 1)), when_active, otherwise)
