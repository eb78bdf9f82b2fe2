"""VGGT without windows: all frames attend to one another in every global block."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import numpy as np

from logvggt_jax.config import WindowConfig
from logvggt_jax.model.logvggt import LogVGGT, Variables


class ChunkPrediction(NamedTuple):
    """What is predicted of n frames, numpy arrays in one world and one unit of length.

    Attributes:
      depth: [n, H, W] z-depth.
      depth_confidence: [n, H, W], at least 1.
      extrinsics: [n, 3, 4], world-to-camera (OpenCV).
      intrinsics: [n, 3, 3], pixels of the images.
      points: [n, H, W, 3] in the world; None without point head.
      points_confidence: [n, H, W]; None without point head.
    """

    depth: np.ndarray
    depth_confidence: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    points: np.ndarray | None = None
    points_confidence: np.ndarray | None = None


def plain_vggt(model: LogVGGT, num_frames: int) -> LogVGGT:
    """The same parts with one window that holds `num_frames` frames: VGGT with full global attention.

    The camera head sees all frames. Refinement runs once over all of them where the model has it, since its camera
    head was trained on refined tokens; with public VGGT weights it is the identity.
    """
    size = max(2, num_frames)
    # One window leaves no work for the stride; half the size lets encoder and dense heads run in two halves.
    windows = WindowConfig(size=size, stride=size // 2, cross_window=False)
    refinement = dataclasses.replace(model.config.refinement, period=None, context=None)
    return LogVGGT(dataclasses.replace(model.config, windows=windows, refinement=refinement))


def predict_plain(model: LogVGGT, variables: Variables, images: np.ndarray) -> ChunkPrediction:
    """Plain VGGT's prediction of images [n, H, W, 3], in the frame of the first; compiled once for each n.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      images: uint8, or floating point in [0, 1].
    """
    return jax.device_get(_predict(plain_vggt(model, len(images)), variables, images))


@functools.partial(jax.jit, static_argnums=0)
def _predict(model: LogVGGT, variables: Variables, images: jax.Array) -> ChunkPrediction:
    predictions = model.apply(variables, images[None])
    wanted = {name: getattr(predictions, name) for name in ChunkPrediction._fields}
    return jax.tree.map(lambda x: x[0], ChunkPrediction(**wanted))
