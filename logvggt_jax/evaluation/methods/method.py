"""What is evaluated: anything that turns a clip's images into depth and cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from logvggt_jax.evaluation.progress import track
from logvggt_jax.evaluation.records import record_key
from logvggt_jax.evaluation.scratch import scratch_array
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.streaming import METHODS, Predictor, open_predictor
from logvggt_jax.weights.checkpoints import load_model
from logvggt_jax.weights.digests import digests


class ClipPrediction(NamedTuple):
    """Prediction of one clip, numpy arrays (depth may be a memory map); any unit of length, any world."""

    depth: np.ndarray | None  # [T, H, W] z-depth; None if the method does not predict any
    extrinsics: np.ndarray  # [T, 3, 4] or [T, 4, 4], world-to-camera (OpenCV)
    intrinsics: np.ndarray | None  # [T, 3, 3], pixels of the clip's images; None with `depth`


@dataclasses.dataclass(frozen=True, eq=False)
class Checkpoint:
    """A model that rows are made of."""

    model: LogVGGT  # the model
    variables: Variables  # {"params": …}, on the device, in the compute type: rows open a predictor for every clip
    digest: str  # of the parameters

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """The model of a folder; errors as of `logvggt_jax.weights.load_model`."""
        model, variables = load_model(path)
        digest = record_key(digests(variables["params"]))
        return cls(model, jax.device_put(in_compute_type(variables, model.config)), digest)


@dataclasses.dataclass(frozen=True)
class Method:
    """A row of the table."""

    name: str  # label of the row
    knows: str  # what the method was given besides the images, in words, for the reader of the table
    # Images [T, H, W, 3] uint8, a memory map where they are many, to the clip's prediction; raises PredictionError
    # where it has none.
    predict: Callable[[np.ndarray], ClipPrediction]
    # What decides the predictions of given images besides the code, as JSON values: sizes, parameters, settings. What
    # it does not name is taken for unchanged by a later run.
    identity: Any = None
    # Opens the predictor behind `predict`, to be timed; None for what has none.
    start: Callable[[], Predictor] | None = None
    depth: bool = True  # whether depth is measured
    pose: bool = True  # whether poses are measured
    points: bool = True  # whether the point cloud is measured
    # The camera never moves by construction; its ATE is then the trajectory's RMS radius, since no similarity exists.
    static: bool = False


def predicted(predictor: Predictor, images: np.ndarray) -> ClipPrediction:
    """A whole clip [T, H, W, 3] uint8 through a predictor; depth goes to disk as it comes, where the clip is long.

    No frame has been pushed to the predictor, which is closed afterwards; images may be a memory map. Raises
    PredictionError where it cannot take this clip.
    """
    depth = handed_out(predictor, images)
    cameras = predictor.cameras()
    return ClipPrediction(scaled(depth, cameras.depth_scale), cameras.extrinsics, cameras.intrinsics)


def handed_out(predictor: Predictor, images: np.ndarray) -> np.ndarray:
    """The depth [T, H, W] that a predictor hands out, as `predicted`."""
    depth = scratch_array(images.shape[:3], np.float32)
    for image in track(images, len(images), f"network, {len(images)} frames"):
        for result in predictor.push(image):
            depth[result.index] = result.depth
    for result in predictor.close():
        depth[result.index] = result.depth
    return depth


def scaled(depth: np.ndarray, scale: np.ndarray | None) -> np.ndarray:
    """Depth [T, H, W] times factors [T] of its frames, in an array of its own; itself where there are none."""
    if scale is None:
        return depth
    product = scratch_array(depth.shape, np.float32)
    for index, factor in enumerate(scale):
        product[index] = depth[index] * factor
    return product


def model_row(
    method: str, checkpoint: Checkpoint, settings: Any = None, *, name: str | None = None, knows: str | None = None
) -> Method:
    """A row of the model, run by the `method` of that name of `logvggt_jax.streaming.METHODS`.

    `settings` are the method's own dataclass, None for its defaults; `name` is the row's label and `knows` what the
    table says of it, by default the method's title, and its summary with the settings that are not the defaults.
    """
    found = METHODS[method]

    def start() -> Predictor:
        return open_predictor(method, checkpoint.model, checkpoint.variables, settings)

    described, defaults = (dataclasses.asdict(each) for each in (found.chosen(settings), found.settings()))
    if knows is None:
        chosen = ", ".join(f"{key}={value}" for key, value in described.items() if value != defaults[key])
        knows = f"its training; {found.summary}{f' ({chosen})' if chosen else ''}"
    identity = [method, described, checkpoint.model.config.to_dict(), checkpoint.digest]
    return Method(name or found.title, knows, lambda images: predicted(start(), images), identity, start)
