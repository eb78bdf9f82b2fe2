"""What comes out of a stream, frame by frame, and what may go in."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from logvggt_jax.compile import out_of_device_memory
from logvggt_jax.errors import InputError
from logvggt_jax.geometry import decode_poses
from logvggt_jax.model.checks import check_pixels


class PredictionError(InputError):
    """A method cannot predict a sequence: too long for the memory, frames larger than all that it may keep, nothing to
    align."""


@dataclasses.dataclass(frozen=True)
class FrameResult:
    """One frame whose depth is final, numpy arrays.

    Attributes:
      index: position in the stream, from 0.
      depth: [H, W] float32, z-depth in the unit of the poses' translations; 0 where a mask drops the pixel. Where loops
        are closed when the sequence ends, `Cameras.depth_scale` then says by which factor it changes.
      confidence: [H, W] float32, at least 1; 0 where a mask drops the pixel.
      pose_encoding: [9] float32, see `logvggt_jax.geometry.decode_poses`; None while the frame has no pose.
      pose_is_final: whether `pose_encoding` stays as it is.
      points: [H, W, 3] float32 in the first camera's frame; None without point head.
      points_confidence: [H, W] float32; None without point head.
      latency: seconds from the frame's `push` to this result; None where it is not measured.
      overlap_change: difference between the frame's camera tokens in its last two windows, as a fraction of their
        norm: it rises where windows do not agree. None where the frame was in one window, and for other methods.
    """

    index: int
    depth: np.ndarray
    confidence: np.ndarray
    pose_encoding: np.ndarray | None
    pose_is_final: bool
    points: np.ndarray | None
    points_confidence: np.ndarray | None
    latency: float | None = None
    overlap_change: float | None = None


# Told how much of something is done, and of how much.
Progress = Callable[[int, int], object]


class Signals(NamedTuple):
    """What a stream tells of its own quality, for the first N frames, numpy arrays; NaN where it is not known.

    Attributes:
      overlap_change: [N] float32, see `FrameResult`.
      correction: [N] float32, how far GCCR moved the camera token, as a fraction of its norm.
      chunk_scale: [N] float32, the size of a chunk's unit in the first one's, at the first frame that the chunk adds.
      chunk_residual: [N] float32, at the same frames: the median distance between both predictions of the points that
        the chunk shares with the one before, once it is aligned, as a fraction of their median depth.
    """

    overlap_change: np.ndarray
    correction: np.ndarray
    chunk_scale: np.ndarray
    chunk_residual: np.ndarray

    @classmethod
    def unknown(cls, count: int) -> Signals:
        """Of `count` frames of which nothing is known but their depth and pose."""
        return cls(*(np.full(count, np.nan, np.float32) for _ in cls._fields))


class Cameras(NamedTuple):
    """Cameras of the first N frames of a stream, numpy arrays.

    Attributes:
      pose_encoding: [N, 9] float32.
      extrinsics: [N, 3, 4] float32, world-to-camera (OpenCV); the world is the first camera's frame.
      intrinsics: [N, 3, 3] float32, pixels of the model's input.
      is_final: bool [N], False where later frames may still move the pose.
      depth_scale: [N] float32, the factors that the depth of the frames, as it was handed out, needs to fit these
        cameras; None where it fits as it is.
      loops: int64 [L, 2], the frames at which the sequence came back to a place; None where nobody looked for them.
    """

    pose_encoding: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    is_final: np.ndarray
    depth_scale: np.ndarray | None = None
    loops: np.ndarray | None = None

    def first(self, count: int) -> Cameras:
        """Those of the first `count` frames, and the loops among these."""
        return Cameras(
            self.pose_encoding[:count],
            self.extrinsics[:count],
            self.intrinsics[:count],
            self.is_final[:count],
            None if self.depth_scale is None else self.depth_scale[:count],
            None if self.loops is None else self.loops[(self.loops < count).all(axis=1)],
        )


def decoded_cameras(encodings: np.ndarray, image_size: tuple[int, int], *, final: int) -> Cameras:
    """Cameras of pose encodings [N, 9] for images of (H, W) pixels, the first `final` of which are final."""
    # A field of view of zero, which untrained models predict, is an infinite focal length.
    with np.errstate(divide="ignore"):
        extrinsics, intrinsics = decode_poses(encodings, image_size)
    return Cameras(encodings.copy(), extrinsics, intrinsics, np.arange(len(encodings)) < final)


def checked_frames(
    frames: np.ndarray | jax.Array | Sequence[np.ndarray], *, patch_size: int, before: np.ndarray | None
) -> np.ndarray:
    """Frames [n, H, W, 3] of one frame [H, W, 3] or several, fit for the model.

    Args:
      frames: uint8 or floating point in [0, 1].
      patch_size: H and W must be multiples of it.
      before: an earlier frame [H, W, 3] of the same stream, whose shape and dtype these must have.

    Raises:
      ValueError: another shape or dtype.
    """
    # A copy: a stream keeps frames until their window is full, and whoever reads a camera may use one buffer for all.
    frames = np.array(frames)
    frames = frames[None] if frames.ndim == 3 else frames
    shape = frames.shape
    if len(shape) != 4 or shape[-1] != 3 or 0 in shape:
        raise ValueError(f"frames must have shape [n, H, W, 3] or [H, W, 3], got {shape}")
    check_pixels(frames, patch_size, "frames")
    if before is not None and (before.shape != shape[1:] or before.dtype != frames.dtype):
        raise ValueError(
            f"frames of a stream must be alike: {before.dtype} {before.shape} before, now {frames.dtype} {shape[1:]}"
        )
    return frames


def checked_masks(
    masks: np.ndarray | jax.Array | None,
    frames: np.ndarray,
    *,
    before: np.ndarray | None,
    mask_before: np.ndarray | None,
) -> np.ndarray | None:
    """Masks bool [n, H, W] of frames [n, H, W, 3], of one mask [H, W] or as many; None for frames without.

    Args:
      masks: bool, True for pixels that count.
      frames: that they are of.
      before: an earlier frame of the same stream; None where there was none.
      mask_before: its mask.

    Raises:
      ValueError: another shape or dtype, or a stream of which some frames have masks and others none.
    """
    if before is not None and (masks is None) != (mask_before is None):
        raise ValueError(
            "a stream has masks for all frames or for none: give masks that are True everywhere for frames without"
        )
    if masks is None:
        return None
    masks = np.asarray(masks)
    size = frames.shape[:3]
    if masks.dtype != np.bool_ or masks.shape not in (size, size[1:]):
        raise ValueError(
            f"masks must be bool {list(size)} or {list(size[1:])} for these frames, got {masks.dtype} "
            f"{list(masks.shape)}"
        )
    return np.array(np.broadcast_to(masks, size))


def refuse_masks(masks: object, instead: str) -> None:
    """For methods that take none: InputError where there are masks, with what to take `instead`."""
    if masks is not None:
        raise InputError(f"this method takes no masks: take {instead}")


@contextlib.contextmanager
def device_memory(what: str, mend: str) -> Iterator[None]:
    """Turns the device's being out of memory into a PredictionError: what did not fit, and what lowers it."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if not out_of_device_memory(error):
            raise
        reason = str(error).splitlines()[0]
        device = jax.devices()[0].device_kind
        raise PredictionError(f"{what} did not fit the memory of {device}: {mend} ({reason})") from error
