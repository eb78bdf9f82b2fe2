"""The model over a clip of any length: windows one by one, depth to disk where it is large, cameras at the end."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.evaluation.progress import track
from logvggt_jax.evaluation.scratch import scratch_array
from logvggt_jax.geometry import decode_poses
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.windows import WindowState
from logvggt_jax.types import WindowOutput

_CHUNK = 64  # token counts are rounded up to it, so that clips of similar length share the camera head's program


class StreamedClip(NamedTuple):
    """Outputs of a clip, numpy arrays in the order of its frames.

    Attributes:
      depth: [T, H, W] float32 z-depth.
      extrinsics: [T, 3, 4] float32, world-to-camera (OpenCV) in the first camera's frame.
      intrinsics: [T, 3, 3] float32, pixels of the images.
    """

    depth: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray


class StreamedWindows(NamedTuple):
    """What the windows of a clip give, numpy arrays in the order of its frames.

    Attributes:
      depth: [T, H, W] float32 z-depth; on disk where it is large.
      camera_tokens: [T, 2C].
      register_tokens: [T, R, 2C].
    """

    depth: np.ndarray
    camera_tokens: np.ndarray
    register_tokens: np.ndarray


@functools.partial(jax.jit, static_argnums=0)
def _start(model: LogVGGT, variables: Any, frames: jax.Array, mask: jax.Array) -> WindowState:
    return model.start(variables, frames, mask)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _step(
    model: LogVGGT, variables: Any, state: WindowState, frames: jax.Array, mask: jax.Array
) -> tuple[WindowState, WindowOutput]:
    return model.step(variables, state, frames, mask)


@functools.partial(jax.jit, static_argnums=0)
def _finish(model: LogVGGT, variables: Any, state: WindowState) -> WindowOutput:
    return model.finish(variables, state)


@functools.partial(jax.jit, static_argnums=0)
def _cameras(model: LogVGGT, variables: Any, camera: jax.Array, register: jax.Array, mask: jax.Array) -> jax.Array:
    return model.refinement.refine_sequence(variables, camera, register, mask)[:, :, -1]


def stream_clip(model: LogVGGT, variables: Any, images: np.ndarray) -> StreamedClip:
    """The numbers of `model.apply` on the whole clip, in every refinement mode, at constant device memory.

    Only the compact tokens (camera and registers, 40 kB a frame in VGGT-1B's size) stay until the end; depth leaves
    the device window by window.

    Args:
      model: the model.
      variables: {"params": …}, on the device.
      images: [T, H, W, 3] uint8, T >= 1; may be a memory map.
    """
    windows = stream_windows(model, variables, images)
    return StreamedClip(windows.depth, *refined_cameras(model, variables, windows))


def stream_windows(model: LogVGGT, variables: Any, images: np.ndarray) -> StreamedWindows:
    """All windows of a clip, without refinement and cameras; arguments as of `stream_clip`."""
    size, stride = model.config.windows.size, model.config.windows.stride
    network = without_refinement(model)
    collector = _Collector(images.shape)
    held = size - stride
    state = _start(network, variables, *_slice(images, 0, held))
    firsts = range(held, max(len(images), held + 1), stride)
    waiting: WindowOutput | None = None
    for first in track(firsts, len(firsts), f"network, {len(images)} frames"):
        state, output = _step(network, variables, state, *_slice(images, first, stride))
        # The device works on this window while the last one's depth is written.
        if waiting is not None:
            collector.take(waiting)
        waiting = output
    assert waiting is not None  # there is at least one step
    collector.take(waiting)
    collector.take(_finish(network, variables, state))
    return collector.windows()


def without_refinement(model: LogVGGT) -> LogVGGT:
    """The model as windows know it: models that differ in refinement alone share their programs."""
    plain = dataclasses.replace(model.config.refinement, enabled=True, period=None, context=None)
    return LogVGGT(dataclasses.replace(model.config, refinement=plain))


def refined_cameras(model: LogVGGT, variables: Any, windows: StreamedWindows) -> tuple[np.ndarray, np.ndarray]:
    """Extrinsics [T, 3, 4] and intrinsics [T, 3, 3] of a clip, in the model's mode of refinement.

    Args:
      model: that of `windows`, but for its refinement.
      variables: {"params": …}, on the device.
      windows: of the whole clip.
    """
    count = len(windows.depth)
    padding = -count % _CHUNK
    camera, register = (
        np.pad(tokens, [(0, padding), *[(0, 0)] * (tokens.ndim - 1)])[None]
        for tokens in (windows.camera_tokens, windows.register_tokens)
    )
    mask = (np.arange(count + padding) < count)[None]
    encodings = np.asarray(_cameras(model, variables, camera, register, mask))[0, :count]
    # A field of view of zero, which untrained models predict, is an infinite focal length.
    with np.errstate(divide="ignore"):
        return decode_poses(encodings, windows.depth.shape[1:])


class _Collector:
    def __init__(self, shape: tuple[int, ...]) -> None:
        self._depth = scratch_array(shape[:3], np.float32)
        self._camera: list[np.ndarray] = []
        self._register: list[np.ndarray] = []
        self._count = 0

    def take(self, output: WindowOutput) -> None:
        valid = int(np.asarray(output.frame_mask[0]).sum())
        self._depth[self._count : self._count + valid] = np.asarray(output.depth[0])[:valid]
        self._camera.append(np.asarray(output.camera_tokens[0])[:valid])
        self._register.append(np.asarray(output.register_tokens[0])[:valid])
        self._count += valid

    def windows(self) -> StreamedWindows:
        return StreamedWindows(self._depth, np.concatenate(self._camera), np.concatenate(self._register))


def _slice(images: np.ndarray, first: int, count: int) -> tuple[jax.Array, jax.Array]:
    """Frames [1, count, H, W, 3] from `first` and their mask; beyond the end the last frame is repeated."""
    chosen = np.minimum(np.arange(first, first + count), len(images) - 1)
    return jnp.asarray(images[chosen][None]), jnp.asarray((np.arange(first, first + count) < len(images))[None])
