"""LoG-VGGT: windows and refinement wired into pure functions of parameters and arrays."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Container, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from logvggt_jax.config import ModelConfig, RefinementConfig, WindowConfig
from logvggt_jax.geometry.pose_encoding import decode_poses
from logvggt_jax.model.checks import check_images, checked_mask
from logvggt_jax.model.cross_window import CrossWindowMemory
from logvggt_jax.model.explicit_axes import splits_as_its_batch
from logvggt_jax.model.parameters import Variables, stack_layers, unstack_layers
from logvggt_jax.model.refinement import Refinement
from logvggt_jax.model.windows import Windows, WindowState
from logvggt_jax.types import Predictions, WindowOutput

__all__ = ["LogVGGT", "Variables", "predictions_of", "shallow", "variable_shapes"]


class ModuleCall(NamedTuple):
    """A module with what it is called with: abstract arrays, and what is static."""

    module: nn.Module
    inputs: tuple[Any, ...]
    static: Mapping[str, Any] = MappingProxyType({})


def _drawn(call: ModuleCall, key: jax.Array) -> Any:
    """Random parameters of a module.

    It is traced, while generators run as they are met (`ShapeCheck.param`): they compile once a shape, where a jitted
    program would inline one for each parameter. Linen's `lazy_init` would compile an empty program for each operation.
    """
    if isinstance(key, jax.core.Tracer):
        return call.module.lazy_init(key, *call.inputs, **call.static)["params"]
    drawn = []

    def trace(*inputs: Any) -> None:
        drawn.append(call.module.init(key, *inputs, **call.static)["params"])

    jax.eval_shape(trace, *call.inputs)
    return jax.tree.map(jnp.asarray, drawn[0])


# Names of layers after the first.
_LATER = r"block_[1-9]\d*$"


@dataclasses.dataclass(frozen=True)
class LogVGGT:
    """The model: hashable, hence static under jit; every method is pure.

        model = LogVGGT(ModelConfig())
        variables = model.init(jax.random.key(0), images)
        predictions = jax.jit(model.apply)(variables, images)

    `start`, `step`, `finish` and `refine` give `apply`'s numbers for a stream, group by group of frames. The parts are
    `windows` (encoder, attention over windows, dense heads) and `refinement` (GCCR and camera head).
    Images are RGB [B, T, H, W, 3], float32 in [0, 1] or uint8, H and W multiples of the patch size. Methods raise
    ValueError for another shape or dtype.
    """

    config: ModelConfig = ModelConfig()

    @property
    def windows(self) -> Windows:
        """Thinking locally: everything up to depth and compact tokens."""
        return Windows(self.config)

    @property
    def refinement(self) -> Refinement:
        """Refining globally: from compact tokens to poses."""
        return Refinement(self.config)

    def init(self, key: jax.Array, images: jax.Array, *, only: Container[str] | None = None) -> Variables:
        """Random parameters {"params": …}, float32; `images` [B, T, H, W, 3] are checked, not read.

        `only` names the modules that are drawn; None for all.
        """
        check_images(images, self.config.encoder.patch_size)
        calls = self.calls((images.shape[2], images.shape[3]))
        keys = jax.random.split(key, 6)
        return {
            "params": {
                name: _drawn(call, key)
                for key, (name, call) in zip(keys, calls.items(), strict=False)
                if only is None or name in only
            }
        }

    def calls(self, image_size: tuple[int, int]) -> dict[str, ModuleCall]:
        """Each module by the name of its parameters, with abstract inputs for one frame of `image_size` (H, W)."""
        config, windows, refinement = self.config, self.windows, self.refinement
        grid = windows.grid(image_size)
        width, patches, registers = config.encoder.embed_dim, grid[0] * grid[1], config.aggregator.num_registers

        def floats(*shape: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, jnp.float32)

        lengths, first = jax.ShapeDtypeStruct((1,), jnp.int32), jax.ShapeDtypeStruct((1,), bool)
        cached = floats(1, len(config.aggregator.key_layers), 1, patches + 1 + registers, width)
        memory = CrossWindowMemory(cached, lengths, config.aggregator.key_layers)  # type: ignore[arg-type]
        camera, levels = floats(1, 1, 2 * width), [floats(1, patches, 2 * width)] * 4
        dense: dict[str, Any] = {"grid": grid, "image_size": image_size}
        calls = {
            "encoder": ModuleCall(windows.encoder, (floats(1, *image_size, 3),)),
            "aggregator": ModuleCall(
                windows.aggregator, (floats(1, 1, patches, width), lengths, first, memory), {"grid": grid}
            ),
            "camera_head": ModuleCall(refinement.camera_head, (camera, lengths)),
            "depth_head": ModuleCall(windows.depth_head, (levels,), dense),
            "gccr": ModuleCall(refinement.gccr, (camera, floats(1, 1, registers, 2 * width), lengths)),
        }
        if config.point_head is not None:
            calls["point_head"] = ModuleCall(windows.point_head, (levels,), dense)
        return calls

    @splits_as_its_batch
    def apply(
        self,
        variables: Variables,
        images: jax.Array,
        frame_mask: jax.Array | None = None,
        *,
        masks: jax.Array | None = None,
        remat: bool = False,
    ) -> Predictions:
        """Cameras, depth and tokens of sequences of any length T >= 1.

        Args:
          variables: {"params": …}.
          images: [B, T, H, W, 3].
          frame_mask: bool [B, T], True … True False … False for sequences of unequal length; None for full ones.
            Entries of padded frames mean nothing.
          masks: bool [B, T, H, W], True for pixels that count; None for all pixels. What lies under a mask has no
            influence on anything: its pixels are not seen, nothing attends to patches of which more than half is
            masked, and depth, points and confidences are 0 there. A frame that is masked whole gets a camera all the
            same, which means nothing.
          remat: for training. Layers run as one loop, and the backward pass keeps what enters a layer or a dense head
            and recomputes the rest; a frozen encoder runs once a frame.
        """
        check_images(images, self.config.encoder.patch_size)
        if remat:
            out = Windows(self.config, remat=True).scan(stack_layers(variables), images, frame_mask, masks)
        else:
            out = self.windows.scan(variables, images, frame_mask, masks)
        frame_mask = checked_mask(images, frame_mask)
        pose_encodings = self.refinement.refine_sequence(variables, out.camera_tokens, out.register_tokens, frame_mask)
        return predictions_of(out, pose_encodings, (images.shape[2], images.shape[3]))

    @splits_as_its_batch
    def start(
        self,
        variables: Variables,
        frames: jax.Array,
        frame_mask: jax.Array | None = None,
        masks: jax.Array | None = None,
    ) -> WindowState:
        """The state of a stream before its first window, of its first K − s frames [B, K − s, H, W, 3].

        With `masks` [B, K − s, H, W], see `apply`, every `step` has to have masks, too.
        """
        return self.windows.start(variables, frames, frame_mask, masks)

    @splits_as_its_batch
    def step(
        self,
        variables: Variables,
        state: WindowState,
        frames: jax.Array,
        frame_mask: jax.Array | None = None,
        masks: jax.Array | None = None,
    ) -> tuple[WindowState, WindowOutput]:
        """Runs the window that s new frames [B, s, H, W, 3] complete; its s oldest frames become final.

        See `Windows.step`; `state` may be donated.
        """
        return self.windows.step(variables, state, frames, frame_mask, masks)

    @splits_as_its_batch
    def finish(self, variables: Variables, state: WindowState) -> WindowOutput:
        """The K − s frames that the last window still holds.

        Before the first `step` no frame has met another, and `frame_mask` of the result is False throughout: a sequence
        of at most K − s frames takes one `step` whose frames are all masked.
        """
        return self.windows.finish(variables, state)

    @splits_as_its_batch
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
        return self.refinement.refine(variables, camera_tokens, register_tokens, camera_mask, register_mask)


def predictions_of(out: WindowOutput, pose_encodings: jax.Array, image_size: tuple[int, int]) -> Predictions:
    """All that is predicted, of the outputs of all frames and their poses [B, T, rounds, 9], for images (H, W)."""
    pose_encoding = pose_encodings[:, :, -1]
    extrinsics, intrinsics = decode_poses(pose_encoding, image_size)
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


def shallow(config: ModelConfig) -> ModelConfig:
    """The model with as few layers as there can be, which is traced in a fraction of the time. Layers of a stack are
    alike, and all other parameters have the same shapes and are drawn the same by `init`."""
    levels = tuple(range(len(config.aggregator.key_layers)))
    encoder = dataclasses.replace(config.encoder, depth=1)
    aggregator = dataclasses.replace(config.aggregator, depth=len(levels), key_layers=levels)
    return dataclasses.replace(config, encoder=encoder, aggregator=aggregator)


def variable_shapes(config: ModelConfig) -> Variables:
    """{"params": …} of a model as `jax.ShapeDtypeStruct`s; nothing is allocated.

    Traced once for all configurations that differ only in depth, and in what shapes do not depend on: windows,
    refinement's mode, rounds of the camera head, compute type, form of attention (and tracing cuDNN's asks for a GPU).
    """
    plain = dataclasses.replace(
        shallow(config),
        camera_head=dataclasses.replace(config.camera_head, iterations=1),
        windows=WindowConfig(),
        refinement=RefinementConfig(num_heads=config.refinement.num_heads),
        dtype="float32",
        attention="xla",
    )
    return unstack_layers({"params": _one_of_each_layer(plain)}, config, take=lambda layer, _: layer)


@functools.lru_cache(maxsize=16)
def _one_of_each_layer(config: ModelConfig) -> Variables:
    """Shapes of the parameters of a shallow model, in which one layer of each family stands for the stack."""
    model, patch, key = LogVGGT(config), config.encoder.patch_size, jax.eval_shape(jax.random.key, 0)
    params = {
        name: jax.eval_shape(functools.partial(call.module.init, **call.static), key, *call.inputs)["params"]
        for name, call in model.calls((patch, patch)).items()
    }

    def stacked(layers: Any) -> Any:
        return {re.sub(r"block_0$", "blocks", name): x for name, x in layers.items() if not re.search(_LATER, name)}

    return {**params, "encoder": stacked(params["encoder"]), "aggregator": stacked(params["aggregator"])}
