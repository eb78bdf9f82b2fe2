"""VGGT without windows: all frames attend to one another in every global block."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from logvggt_jax.config import WindowConfig, require_counts
from logvggt_jax.geometry import encode_poses
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.streaming.program import Program, abstract_variables, flops_of
from logvggt_jax.streaming.results import (
    Cameras,
    FrameResult,
    PredictionError,
    Progress,
    Signals,
    checked_frames,
    checked_masks,
    device_memory,
)
from logvggt_jax.types import Predictions


class PlainPrediction(NamedTuple):
    """What plain VGGT predicts of n frames, numpy arrays in one world and one unit of length.

    Attributes:
      depth: [n, H, W] z-depth; 0 where a mask drops the pixel.
      depth_confidence: [n, H, W], at least 1; likewise.
      extrinsics: [n, 3, 4], world-to-camera (OpenCV).
      intrinsics: [n, 3, 3], pixels of the images.
      points: [n, H, W, 3] in the world; None without point head.
      points_confidence: [n, H, W]; None without point head.
      pose_encoding: [n, 9], the camera head's own, of which the cameras are; None where they were moved since.
    """

    depth: np.ndarray
    depth_confidence: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    points: np.ndarray | None = None
    points_confidence: np.ndarray | None = None
    pose_encoding: np.ndarray | None = None


def plain_vggt(model: LogVGGT, num_frames: int) -> LogVGGT:
    """The same parts with one window that holds `num_frames` frames: VGGT with full global attention.

    The camera head sees all frames. Refinement runs once over all of them where the model has it, since its camera
    head was trained on refined tokens; with public VGGT weights it is the identity.
    """
    size = max(2, num_frames)
    # One window leaves no work for the stride; half the size lets encoder and dense heads run in two halves.
    windows = WindowConfig(size=size, stride=size // 2, cross_window=False)
    refinement = dataclasses.replace(model.config.refinement, period=None, context=None, max_registers=None)
    return LogVGGT(dataclasses.replace(model.config, windows=windows, refinement=refinement))


def predict_plain(
    model: LogVGGT, variables: Variables, images: np.ndarray, masks: np.ndarray | None = None
) -> PlainPrediction:
    """Plain VGGT's prediction of images [n, H, W, 3], in the frame of the first; compiled once for each n.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      images: uint8, or floating point in [0, 1].
      masks: bool [n, H, W], see `LogVGGT.apply`; None for none.
    """
    return jax.device_get(_predict(plain_vggt(model, len(images)), variables, images, masks))


@functools.partial(jax.jit, static_argnums=0)
def _predict(
    model: LogVGGT, variables: Variables, images: jax.Array, masks: jax.Array | None = None
) -> PlainPrediction:
    return of_one_sequence(model.apply(variables, images[None], masks=None if masks is None else masks[None]))


def of_one_sequence(predictions: Predictions) -> PlainPrediction:
    """What is handed out of the predictions of a batch of one."""
    wanted = {name: getattr(predictions, name) for name in PlainPrediction._fields}
    return jax.tree.map(lambda x: x[0], PlainPrediction(**wanted))


def plain_program(model: LogVGGT, image_size: tuple[int, int], num_frames: int) -> Program:
    """`predict_plain` of so many frames."""
    plain, variables = plain_vggt(model, num_frames), abstract_variables(model.config)
    images = jax.ShapeDtypeStruct((num_frames, *image_size, 3), np.uint8)
    flops = flops_of(plain, lambda chosen: lambda v, i: chosen.apply(v, i[None]), variables, images)
    return Program(lowered_plain(model, image_size, num_frames), flops, num_frames)


def lowered_plain(model: LogVGGT, image_size: tuple[int, int], num_frames: int) -> jax.stages.Lowered:
    """The program that `predict_plain` calls for so many frames without masks."""
    images = jax.ShapeDtypeStruct((num_frames, *image_size, 3), np.uint8)
    return _predict.lower(plain_vggt(model, num_frames), abstract_variables(model.config), images, None)


class FinalFrames:
    """Frames of plain VGGT that are handed out, and their cameras; all are final."""

    def __init__(self) -> None:
        self._encodings: list[np.ndarray] = []
        self._extrinsics: list[np.ndarray] = []
        self._intrinsics: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._encodings)

    def add(self, prediction: PlainPrediction | None) -> list[FrameResult]:
        """The results of the frames that follow those added so far; None adds none."""
        if prediction is None:
            return []
        first, size = len(self), prediction.depth.shape[1:]
        encodings = prediction.pose_encoding
        if encodings is None:
            encodings = encode_poses(prediction.extrinsics, prediction.intrinsics, size).astype(np.float32)
        self._encodings += list(encodings)
        self._extrinsics += list(prediction.extrinsics)
        self._intrinsics += list(prediction.intrinsics)
        return [
            FrameResult(
                index=first + i,
                depth=prediction.depth[i],
                confidence=prediction.depth_confidence[i],
                pose_encoding=encodings[i],
                pose_is_final=True,
                points=None if prediction.points is None else prediction.points[i],
                points_confidence=None if prediction.points_confidence is None else prediction.points_confidence[i],
            )
            for i in range(len(encodings))
        ]

    def arrays(self) -> dict[str, np.ndarray]:
        """All cameras added so far, for `restore`; nothing where there is none."""
        if not len(self):
            return {}
        lists = {"encodings": self._encodings, "extrinsics": self._extrinsics, "intrinsics": self._intrinsics}
        return {name: np.stack(values) for name, values in lists.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave."""
        self._encodings = list(arrays.get("encodings", ()))
        self._extrinsics = list(arrays.get("extrinsics", ()))
        self._intrinsics = list(arrays.get("intrinsics", ()))

    def cameras(self) -> Cameras:
        """Cameras of all frames added so far."""
        if not self._encodings:
            nothing = np.zeros((0, 3, 4), np.float32)
            return Cameras(np.zeros((0, 9), np.float32), nothing, nothing[..., :3], np.zeros(0, bool))
        arrays = [np.stack(x) for x in (self._encodings, self._extrinsics, self._intrinsics)]
        return Cameras(arrays[0], arrays[1], arrays[2], np.ones(len(self), bool))


@dataclasses.dataclass(frozen=True)
class OfflineSettings:
    """Limits of the method: `max_frames` is the longest sequence it takes, None for no limit.

    Memory grows with the frames, time with their square.
    """

    max_frames: int | None = 200

    def __post_init__(self) -> None:
        require_counts(self, "max_frames")


class OfflineSession:
    """Takes frames like a `StreamSession` and hands them all out when the sequence ends.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      settings: limits.
    """

    def __init__(self, model: LogVGGT, variables: Variables, settings: OfflineSettings) -> None:
        self._model, self._settings = model, settings
        self._variables = jax.device_put(in_compute_type(variables, model.config))
        self._images: list[np.ndarray] = []
        self._masks: list[np.ndarray] = []  # of the images; empty where there are none
        self._final = FinalFrames()
        self._closed = False

    @property
    def num_frames(self) -> int:
        """Frames handed out so far."""
        return len(self._final)

    @property
    def state_bytes(self) -> int:
        """See `Predictor.state_bytes`: the images, all of them until the end."""
        return sum(array.nbytes for array in (*self._images, *self._masks))

    def push(
        self, frames: np.ndarray | jax.Array | Sequence[np.ndarray], masks: np.ndarray | None = None
    ) -> list[FrameResult]:
        """Takes frames; see `Predictor.push`. Raises PredictionError for more than `max_frames`."""
        if self._closed:
            raise ValueError(f"this sequence is closed: make another {type(self).__name__} for another one")
        before = self._images[-1] if self._images else None
        frames = checked_frames(frames, patch_size=self._model.config.encoder.patch_size, before=before)
        mask_before = self._masks[-1] if self._masks else None
        masks = checked_masks(masks, frames, before=before, mask_before=mask_before)
        self._images += list(frames)
        self._masks += [] if masks is None else list(masks)
        limit = self._settings.max_frames
        if limit is not None and len(self._images) > limit:
            raise PredictionError(
                f"full attention over {len(self._images)} frames exceeds max_frames={limit}; raise it if memory and "
                "time allow"
            )
        return []

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        """Predicts all frames at once."""
        images, masks, self._images, self._masks, self._closed = self._images, self._masks, [], [], True
        if not images:
            return []
        height, width = images[0].shape[:2]
        with device_memory(
            f"full attention over {len(images)} frames of {height} x {width} pixels", "take fewer or smaller frames"
        ):
            return self._final.add(self._predict(np.stack(images), np.stack(masks) if masks else None))

    def _predict(self, images: np.ndarray, masks: np.ndarray | None) -> PlainPrediction:
        return predict_plain(self._model, self._variables, images, masks)

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """See `Predictor.snapshot`: the frames, since nothing is computed before the end."""
        arrays = {"images": self._images, "masks": self._masks}
        return [], {name: np.stack(values) for name, values in arrays.items() if values}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """See `Predictor.restore`."""
        self._images, self._masks = list(arrays.get("images", ())), list(arrays.get("masks", ()))

    def cameras(self, *, provisional: bool = False) -> Cameras:
        """Cameras of the frames handed out so far."""
        return self._final.cameras()

    def signals(self) -> Signals:
        """See `Predictor.signals`: none."""
        return Signals.unknown(len(self._final))


def offline_program(
    model: LogVGGT, image_size: tuple[int, int], settings: OfflineSettings, num_frames: int | None
) -> Program:
    """All frames at once; of a sequence whose length is not known, as many as are allowed."""
    return plain_program(model, image_size, num_frames or settings.max_frames or 1)
