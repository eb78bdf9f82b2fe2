"""Reference rows on the same backbone and weights: VGGT offline, and plain VGGT on chained chunks."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np

from logvggt_jax.config import require_counts
from logvggt_jax.evaluation.methods.method import Checkpoint, ClipPrediction, Method, PredictionError
from logvggt_jax.streaming.chunks import ChunkChain, ChunkPlan
from logvggt_jax.streaming.offline import predict_plain


@dataclasses.dataclass(frozen=True)
class ReferenceConfig:
    """Limits of the reference models.

    Attributes:
      max_frames: longest clip that VGGT offline takes, whose memory and time grow with the square of the frames;
        longer ones count as failed for it. None for no limit.
      chunk_size: frames of a chunk.
      chunk_overlap: frames that neighbouring chunks share.
    """

    max_frames: int | None = 200
    chunk_size: int = 60
    chunk_overlap: int = 30

    def __post_init__(self) -> None:
        require_counts(self, "max_frames")
        self.plan()

    def plan(self) -> ChunkPlan:
        """The chunks; ValueError for impossible ones."""
        return ChunkPlan(self.chunk_size, self.chunk_overlap)


def offline_vggt(checkpoint: Checkpoint, limits: ReferenceConfig) -> Method:
    """All frames at once with full global attention.

    Its `predict` raises PredictionError for a clip longer than `max_frames`, or one that the device's memory does
    not hold.
    """

    max_frames = limits.max_frames

    def predict(images: np.ndarray) -> ClipPrediction:
        count, height, width = images.shape[:3]
        if max_frames is not None and count > max_frames:
            raise PredictionError(
                f"full attention over {count} frames exceeds references.max_frames={max_frames}; raise it if memory "
                "and time allow"
            )
        try:
            prediction = predict_plain(checkpoint.model, checkpoint.variables, images)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            raise PredictionError(
                f"full attention over {count} frames of {height} x {width} pixels does not fit the memory of "
                f"{jax.devices()[0].device_kind}; set references.max_frames below {count}"
            ) from error
        return ClipPrediction(prediction.depth, prediction.extrinsics, prediction.intrinsics)

    knows = "its training; all frames in one window of full global attention"
    return Method("VGGT offline", knows, predict, ["offline", checkpoint.model.config.to_dict(), checkpoint.digest])


def chunked_vggt(checkpoint: Checkpoint, limits: ReferenceConfig) -> Method:
    """Plain VGGT on overlapping chunks, chained by robust similarities.

    Its `predict` raises PredictionError where neighbouring chunks cannot be aligned.
    """

    plan = limits.plan()

    def predict(images: np.ndarray) -> ClipPrediction:
        chain = ChunkChain(functools.partial(predict_plain, checkpoint.model, checkpoint.variables), plan)
        try:
            chunks = [chunk for image in images if (chunk := chain.push(image)) is not None]
            last = chain.close()
        except ValueError as error:
            raise PredictionError(str(error)) from error
        chunks += [] if last is None else [last]
        fields = ("depth", "extrinsics", "intrinsics")
        return ClipPrediction(*(np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in fields))

    knows = (
        f"its training; windows of {plan.size} frames, {plan.overlap} shared with the next, without memory, chained by "
        "robust similarities"
    )
    identity = ["chunks", dataclasses.asdict(plan), checkpoint.model.config.to_dict(), checkpoint.digest]
    return Method("VGGT on chunks", knows, predict, identity)
