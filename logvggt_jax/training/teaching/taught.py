"""Clips of videos with a teacher's labels in the place of the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.dataset import Dataset, check_indices, check_sequence
from logvggt_jax.data.feeding.frame_range import frames_of
from logvggt_jax.data.feeding.transforms import fit
from logvggt_jax.frames import Frames
from logvggt_jax.training.teaching.labels import stored_labels

Size = tuple[int, int]


@dataclass(frozen=True)
class TaughtClip:
    """One clip that a teacher saw: frames of a sequence of the data set, cut to `size` (H, W), and its labels."""

    sequence: str
    frames: tuple[int, ...]
    size: Size
    labels: Path


class TaughtDataset(Dataset):
    """The clips of a data set that a teacher has labelled, each as a sequence of its own.

    Depth and cameras are the teacher's, with `confidence`; what the data set says of them is not looked at.
    """

    def __init__(self, dataset: Dataset, clips: Mapping[str, TaughtClip], teacher: str) -> None:
        self._dataset, self._clips, self._teacher = dataset, dict(clips), teacher

    @property
    def sequences(self) -> Sequence[str]:
        """As of `Dataset`; named as the sequence that was cut, `@` and the first frame."""
        return tuple(self._clips)

    @property
    def identity(self) -> Mapping[str, Any]:
        """As of `Dataset`."""
        return {**self._dataset.identity, "teacher": self._teacher}

    def range(self, sequence: str) -> range:
        """As of `PartOfFrames`."""
        clip = self._clip(sequence)
        step = clip.frames[1] - clip.frames[0]
        return frames_of(self._dataset, clip.sequence)[clip.frames[0] : clip.frames[-1] + 1 : step]

    def num_frames(self, sequence: str) -> int:
        """As of `Dataset`."""
        return len(self._clip(sequence).frames)

    def image_size(self, sequence: str) -> Size:
        """As of `Dataset`."""
        return self._clip(sequence).size

    def frame_names(self, sequence: str) -> Sequence[str]:
        """As of `Dataset`."""
        clip = self._clip(sequence)
        names = self._dataset.frame_names(clip.sequence)
        return [names[i] for i in clip.frames]

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """As of `Dataset`."""
        clip = self._clip(sequence)
        chosen = check_indices(indices, len(clip.frames), sequence)
        pictures = fit(self._dataset.read(clip.sequence, [clip.frames[i] for i in chosen]), clip.size)
        labels = stored_labels(clip.labels)
        return Frames(
            images=pictures.images,
            depth=labels.depth[chosen],
            intrinsics=labels.intrinsics[chosen],
            extrinsics=labels.extrinsics[chosen],
            metric=False,
        )

    def confidence(self, sequence: str, indices: Sequence[int]) -> np.ndarray:
        """As of `ConfidentDataset`."""
        clip = self._clip(sequence)
        return stored_labels(clip.labels).confidence[check_indices(indices, len(clip.frames), sequence)]

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """As of `Dataset`."""
        return None

    def _clip(self, sequence: str) -> TaughtClip:
        check_sequence(sequence, self._clips, "the teacher's clips")
        return self._clips[sequence]
