"""What is evaluated: anything that turns a clip's images into depth and cameras."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.types import Predictions


class ClipPrediction(NamedTuple):
    """Prediction of one clip, numpy arrays; any unit of length, any world.

    Attributes:
      depth: [T, H, W] z-depth; None if the method does not predict any.
      extrinsics: [T, 3, 4] or [T, 4, 4], world-to-camera (OpenCV).
      intrinsics: [T, 3, 3], pixels of the clip's images; None with `depth`.
    """

    depth: np.ndarray | None
    extrinsics: np.ndarray
    intrinsics: np.ndarray | None


class PredictionError(ValueError):
    """A method cannot predict a clip: too long for the memory, nothing to align. The clip counts as failed for it."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A row of the table.

    Attributes:
      name: label of the row.
      knows: what the method was given besides the images, in words, for the reader of the table.
      predict: images [T, H, W, 3] uint8 to the clip's prediction; raises PredictionError where it has none.
      depth: whether depth is measured.
      pose: whether poses are measured.
      points: whether the point cloud is measured.
      static: the camera never moves by construction; its ATE is then the trajectory's RMS radius, since no
        similarity exists.
    """

    name: str
    knows: str
    predict: Callable[[np.ndarray], ClipPrediction]
    depth: bool = True
    pose: bool = True
    points: bool = True
    static: bool = False


def network(
    model: LogVGGT, variables: dict[str, Any], *, name: str = "LoG-VGGT", knows: str = "its training"
) -> Method:
    """The model as a method; its program is compiled once for each clip length."""
    apply = _compiled(model)

    def predict(images: np.ndarray) -> ClipPrediction:
        predictions = apply(variables, images[None])
        depth, extrinsics, intrinsics = jax.device_get(
            (predictions.depth[0], predictions.extrinsics[0], predictions.intrinsics[0])
        )
        return ClipPrediction(depth, extrinsics, intrinsics)

    return Method(name, knows, predict)


@functools.lru_cache(maxsize=8)
def _compiled(model: LogVGGT) -> Callable[..., Predictions]:
    """One jitted function a model, so that trained and untrained parameters share its programs."""
    return jax.jit(model.apply)
