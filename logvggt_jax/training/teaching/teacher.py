"""A teacher: plain VGGT, whose predictions on clips of videos are what a student learns."""

from typing import Protocol

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.streaming import open_predictor
from logvggt_jax.streaming.offline import OfflineSettings
from logvggt_jax.training.config import TeacherConfig
from logvggt_jax.training.teaching.labels import Labels
from logvggt_jax.weights.checkpoints import from_pretrained, read_provenance
from logvggt_jax.weights.digests import digests, json_digest

METHOD = "offline"  # of `streaming`: all frames of a clip see one another


class Teacher(Protocol):
    """What labels are asked of."""

    @property
    def digest(self) -> str:
        """Of all that decides its labels besides the pictures."""
        ...

    def label(self, images: np.ndarray) -> Labels:
        """Labels of a clip, images [T, H, W, 3] uint8."""
        ...


class PlainVGGT:
    """The teacher of a run, on the default device. Raises InputError for weights that are not plain VGGT's."""

    def __init__(self, config: TeacherConfig) -> None:
        kind = read_provenance(config.weights).trained_for
        if kind not in ("vggt", None):
            raise InputError(
                f"teacher.weights={config.weights}: trained for {kind!r}, a teacher is plain VGGT ('vggt'): give "
                "VGGT-1B as `logvggt convert` writes it, or a checkpoint of it"
            )
        self._weights = config.weights
        self._model, self._variables = from_pretrained(config.weights)
        parts = {"config": self._model.config.to_dict(), "method": METHOD, "params": digests(self._variables["params"])}
        self.digest = json_digest(parts)

    def label(self, images: np.ndarray) -> Labels:
        """As of `Teacher`. Raises PredictionError where the clip does not fit the device's memory."""
        predictor = open_predictor(METHOD, self._model, self._variables, OfflineSettings(max_frames=None))
        frames = [*predictor.push(images), *predictor.close()]
        cameras = predictor.cameras()
        extrinsics = np.tile(np.eye(4, dtype=np.float32), (len(frames), 1, 1))
        extrinsics[:, :3] = cameras.extrinsics
        labels = Labels(
            np.stack([frame.depth for frame in frames]).astype(np.float32),
            np.stack([frame.confidence for frame in frames]).astype(np.float32),
            np.asarray(cameras.intrinsics, np.float32),
            extrinsics,
        )
        for name, values in labels._asdict().items():
            if not np.isfinite(values).all():
                raise InputError(f"teacher.weights={self._weights}: its {name} is not finite: it teaches nothing")
        return labels
