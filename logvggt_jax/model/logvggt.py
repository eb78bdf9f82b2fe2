"""LoG-VGGT: windows and refinement wired into pure functions of parameters and arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Container

import jax

from logvggt_jax.config import ModelConfig
from logvggt_jax.geometry.pose_encoding import decode_poses
from logvggt_jax.model.checks import check_images, checked_mask
from logvggt_jax.model.explicit_axes import splits_as_its_batch
from logvggt_jax.model.initialization import initial_variables
from logvggt_jax.model.parameters import Variables, stack_layers
from logvggt_jax.model.refinement import Refinement
from logvggt_jax.model.windows import Windows, WindowState
from logvggt_jax.types import Predictions, WindowOutput

__all__ = ["LogVGGT", "Variables", "predictions_of"]


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
        return initial_variables(self.config, key, (images.shape[2], images.shape[3]), only=only)

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
