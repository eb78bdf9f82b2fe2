"""A stream of frames through plain VGGT in overlapping chunks, for weights that never learned the windows' relay."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import numpy as np

from logvggt_jax.geometry import encode_poses
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.streaming.chunks import ChunkChain, ChunkPlan
from logvggt_jax.streaming.offline import ChunkPrediction, predict_plain
from logvggt_jax.streaming.windows import Cameras, FrameResult, checked_frames


class ChunkSession:
    """Takes frames like a `StreamSession` and hands them out chunk by chunk, depth and pose final.

    The world is the first chunk's first camera, the unit the first chunk's. Memory is that of one chunk, and the
    cameras.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      plan: sizes of the chunks.
    """

    def __init__(self, model: LogVGGT, variables: Variables, plan: ChunkPlan) -> None:
        # Once, not for every chunk, where they are numpy arrays.
        predict = functools.partial(predict_plain, model, jax.device_put(variables))
        self._patch_size = model.config.encoder.patch_size
        self._chain = ChunkChain(predict, plan)
        self._newest: np.ndarray | None = None
        self._encodings: list[np.ndarray] = []
        self._extrinsics: list[np.ndarray] = []
        self._intrinsics: list[np.ndarray] = []
        self._closed = False

    @property
    def num_frames(self) -> int:
        """Frames whose depth and pose are final."""
        return len(self._encodings)

    def push(self, frames: np.ndarray | jax.Array | Sequence[np.ndarray]) -> list[FrameResult]:
        """Takes frames and returns those that became final, oldest first.

        Args:
          frames: one frame [H, W, 3] or several [n, H, W, 3], uint8 or floating point in [0, 1]; H and W are
            multiples of the patch size and the same in every call, as is the dtype.

        Raises:
          ValueError: another shape or dtype, the session is closed, or a chunk cannot be aligned.
        """
        if self._closed:
            raise ValueError("this stream is closed: make another ChunkSession for another sequence")
        results: list[FrameResult] = []
        for frame in checked_frames(frames, patch_size=self._patch_size, before=self._newest):
            self._newest = frame
            results += self._collect(self._chain.push(frame))
        return results

    def close(self) -> list[FrameResult]:
        """Ends the stream: the frames still held, oldest first. Raises ValueError where the last chunk does not fit."""
        self._closed, self._newest = True, None
        return self._collect(self._chain.close())

    def cameras(self) -> Cameras:
        """Cameras of the frames handed out so far; all are final."""
        if not self._encodings:
            nothing = np.zeros((0, 3, 4), np.float32)
            return Cameras(np.zeros((0, 9), np.float32), nothing, nothing[..., :3], np.zeros(0, bool))
        arrays = [np.stack(x) for x in (self._encodings, self._extrinsics, self._intrinsics)]
        return Cameras(arrays[0], arrays[1], arrays[2], np.ones(len(self._encodings), bool))

    def _collect(self, chunk: ChunkPrediction | None) -> list[FrameResult]:
        if chunk is None:
            return []
        first = self.num_frames
        encodings = encode_poses(chunk.extrinsics, chunk.intrinsics, chunk.depth.shape[1:]).astype(np.float32)
        self._encodings += list(encodings)
        self._extrinsics += list(chunk.extrinsics)
        self._intrinsics += list(chunk.intrinsics)
        return [
            FrameResult(
                index=first + i,
                depth=chunk.depth[i],
                confidence=chunk.depth_confidence[i],
                pose_encoding=encodings[i],
                pose_is_final=True,
                points=None if chunk.points is None else chunk.points[i],
                points_confidence=None if chunk.points_confidence is None else chunk.points_confidence[i],
            )
            for i in range(len(encodings))
        ]
