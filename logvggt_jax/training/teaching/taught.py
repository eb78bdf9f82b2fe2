"""Clips of videos with a teacher's labels in the place of the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from logvggt_jax.data.dataset import Dataset, check_indices, check_sequence
from logvggt_jax.data.feeding.frame_range import frames_of
from logvggt_jax.data.feeding.transforms import fit
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames
from logvggt_jax.training.teaching.labels import Labels, stored_labels

Size = tuple[int, int]


@dataclass(frozen=True)
class TaughtClip:
    """One clip for a teacher: frames of a sequence of the data set, cut to `size` (H, W), and where its labels lie.

    It has none where its pictures could not be read.
    """

    sequence: str
    frames: tuple[int, ...]
    size: Size
    labels: Path | None


class TaughtDataset(Dataset):
    """The clips of a data set that a teacher has labelled, each as a sequence of its own.

    Depth and cameras are the teacher's, with `confidence`; what the data set says of them is not looked at. Those that
    have no labels are sequences too, of which no frame can be read.
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

    @property
    def labelled_by(self) -> str:
        """As of `ConfidentDataset`."""
        return self._teacher

    def labelled(self) -> "TaughtDataset":
        """The clips that have labels alone."""
        clips = {name: clip for name, clip in self._clips.items() if clip.labels is not None}
        return TaughtDataset(self._dataset, clips, self._teacher)

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
        # First: of a clip without labels no frame is given, also where the one that is damaged is not asked for.
        labels = self._labels(sequence)
        pictures = fit(self._dataset.read(clip.sequence, [clip.frames[i] for i in chosen]), clip.size)
        return Frames(
            images=pictures.images,
            depth=labels.depth[chosen],
            intrinsics=labels.intrinsics[chosen],
            extrinsics=labels.extrinsics[chosen],
            metric=False,
        )

    def confidence(self, sequence: str, indices: Sequence[int]) -> np.ndarray:
        """As of `ConfidentDataset`."""
        chosen = check_indices(indices, self.num_frames(sequence), sequence)
        return self._labels(sequence).confidence[chosen]

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """As of `Dataset`."""
        return None

    def _labels(self, sequence: str) -> Labels:
        clip = self._clip(sequence)
        if clip.labels is None:
            raise InputError(
                f"{sequence} has no labels, its pictures could not be read when the run was started (its log names "
                "them): mend them and start the run again, which labels the clip"
            )
        return stored_labels(clip.labels)

    def _clip(self, sequence: str) -> TaughtClip:
        check_sequence(sequence, self._clips, "the teacher's clips")
        return self._clips[sequence]
