"""A teacher: plain VGGT, whose predictions on clips of videos are what a student learns."""

from typing import Any, Protocol

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.streaming import PredictionError, open_predictor
from logvggt_jax.streaming.offline import OfflineSettings
from logvggt_jax.streaming.results import device_memory
from logvggt_jax.training.config import TeacherConfig
from logvggt_jax.training.teaching.labels import Labels
from logvggt_jax.weights.address import resolve
from logvggt_jax.weights.checkpoints import from_pretrained, read_config, read_digests, read_provenance
from logvggt_jax.weights.digests import digests, json_digest

METHOD = "offline"  # of `streaming`: all frames of a clip see one another


class Teacher(Protocol):
    """What labels are asked of."""

    @property
    def digest(self) -> str:
        """Of all that decides its labels besides the pictures."""
        ...

    def load(self) -> None:
        """Reads what labelling needs, where that was not done: raises now what the first clip would."""
        ...

    def label(self, images: np.ndarray) -> Labels:
        """Labels of a clip, images [T, H, W, 3] uint8."""
        ...


def check_teacher(config: TeacherConfig) -> None:
    """Raises MissingInput where there are no such weights, InputError where they are known not to be plain VGGT's.

    Reads no parameter; weights of a hub are downloaded.
    """
    kind = read_provenance(config.weights).trained_for
    if kind not in ("vggt", None):
        raise InputError(
            f"teacher.weights={config.weights}: trained for {kind!r}, a teacher is plain VGGT ('vggt'): give "
            "VGGT-1B as `logvggt convert` writes it, or a checkpoint of it"
        )


class PlainVGGT:
    """The teacher of a run, on the default device. Its weights are read when the first clip is labelled, and at once
    where only they tell their digests. Raises InputError for weights that are not plain VGGT's."""

    def __init__(self, config: TeacherConfig) -> None:
        check_teacher(config)
        self._config = config
        self._path = resolve(config.weights)
        self._weights: tuple[LogVGGT, dict[str, Any]] | None = None
        self._told, sizes = read_digests(self._path), read_config(self._path)
        params = digests(self._loaded()[1]["params"]) if self._told is None else self._told
        self.digest = json_digest({"config": sizes.to_dict(), "method": METHOD, "params": params})

    def load(self) -> None:
        """As of `Teacher`. Raises InputError as `from_pretrained` and where other weights lie there by now,
        PredictionError where they do not fit the device's memory."""
        self._loaded()

    def label(self, images: np.ndarray) -> Labels:
        """As of `Teacher`. Raises what `load` does, and PredictionError where the clip does not fit the device's
        memory."""
        predictor = open_predictor(METHOD, *self._loaded(), OfflineSettings(max_frames=None))
        try:
            frames = [*predictor.push(images), *predictor.close()]
        except PredictionError as error:
            weights, length = self._config.weights, self._config.clip_length
            raise PredictionError(
                f"teacher.weights={weights}: {error}; lower teacher.clip_length={length} or the stages' sizes"
            ) from error
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
                raise InputError(
                    f"teacher.weights={self._config.weights}: its {name} is not finite: it teaches nothing"
                )
        return labels

    def _loaded(self) -> tuple[LogVGGT, dict[str, Any]]:
        if self._weights is None:
            with device_memory(
                f"teacher.weights={self._config.weights}", "give a smaller teacher, or train on devices with more"
            ):
                weights = from_pretrained(self._path)
            # Hours may have gone by, and their labels would be taken for those of the weights that the digest is of.
            if read_digests(self._path) != self._told:
                raise InputError(
                    f"teacher.weights={self._config.weights}: other weights lie there than when this run began: give a "
                    "copy that stays, and start it again"
                )
            self._weights = weights
        return self._weights
