"""A part of every sequence of a data set, as a data set: the first frames to train on, the last ones to validate on."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from logvggt_jax.data.dataset import Dataset, DrawnOnDevice, check_indices
from logvggt_jax.data.feeding.sampling import CovisibleDataset
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames

Range = tuple[int | None, int | None]
"""First frame and the one after the last, as in a slice of Python: None is an end, negative ones count from the end."""


@runtime_checkable
class PartOfFrames(Protocol):
    """A data set that gives a part of the frames of another one."""

    def range(self, sequence: str) -> range:
        """The frames of `sequence`, as the whole set counts them."""
        ...


class FrameRange(Dataset):
    """Frames `first` to `stop` of every sequence of `dataset`, numbered from 0.

    Sequences keep their names; one that has no such frames has none. Raises InputError for sets whose frames have no
    order in time, and for those drawn on the device.
    """

    def __init__(self, dataset: Dataset, frames: Range, name: str) -> None:
        if isinstance(dataset, CovisibleDataset):
            raise InputError(f"{name}: its frames have no order in time, so that none are the first: leave frames out")
        if isinstance(dataset, DrawnOnDevice):
            raise InputError(f"{name}: drawn on the device, where sequences are whole: leave frames out, or use 'host'")
        self._dataset, self._frames = dataset, frames

    @property
    def sequences(self) -> Sequence[str]:
        """As of `Dataset`."""
        return self._dataset.sequences

    @property
    def identity(self) -> Mapping[str, Any]:
        """As of `Dataset`."""
        return {**self._dataset.identity, "frames": list(self._frames)}

    def range(self, sequence: str) -> range:
        """As of `PartOfFrames`."""
        return range(self._dataset.num_frames(sequence))[slice(*self._frames)]

    def num_frames(self, sequence: str) -> int:
        """As of `Dataset`."""
        return len(self.range(sequence))

    def image_size(self, sequence: str) -> tuple[int, int]:
        """As of `Dataset`."""
        return self._dataset.image_size(sequence)

    def frame_names(self, sequence: str) -> Sequence[str]:
        """As of `Dataset`."""
        return self._dataset.frame_names(sequence)[slice(*self._frames)]

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """As of `Dataset`."""
        return self._dataset.read(sequence, self._of_the_whole(sequence, indices))

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """As of `Dataset`."""
        return self._dataset.sfm_extrinsics(sequence, self._of_the_whole(sequence, indices))

    def _of_the_whole(self, sequence: str, indices: Sequence[int]) -> list[int]:
        frames = self.range(sequence)
        return [frames[i] for i in check_indices(indices, len(frames), f"{sequence}, frames {self._frames}")]


def longest(dataset: Dataset) -> str:
    """How many frames the longest sequence has, in words: of a range that leaves none one sees it here."""
    count = max((dataset.num_frames(sequence) for sequence in dataset.sequences), default=0)
    return f"the longest has {count}{' of the frames that are asked for' if isinstance(dataset, FrameRange) else ''}"


def frames_of(dataset: Dataset, sequence: str) -> range:
    """The frames of `sequence` in a view of a data set, the whole or a part of it, as the whole counts them."""
    return dataset.range(sequence) if isinstance(dataset, PartOfFrames) else range(dataset.num_frames(sequence))


def shared_frames(trained: Dataset, evaluated: Dataset, sequence: str) -> bool:
    """Whether two views of one data set, each the whole or a range of it, share frames of `sequence`."""
    ranges = [frames_of(each, sequence) for each in (trained, evaluated)]
    return bool(range(max(r.start for r in ranges), min(r.stop for r in ranges)))
