"""Single clips, read and made ready for training; where one cannot be read, the next takes its place."""

from collections.abc import Sequence
from typing import Any

import grain
import numpy as np

from logvggt_jax.data.dataset import ConfidentDataset, Dataset, DrawnOnDevice, check_frames
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.broken_clips import describe
from logvggt_jax.data.feeding.sampling import Sampler, example_rng
from logvggt_jax.data.feeding.transforms import fit_each
from logvggt_jax.errors import InputError

Size = tuple[int, int]

FIELDS = ("images", "depth", "intrinsics", "extrinsics")  # of clips that are not drawn on the device
CONFIDENCE = "confidence"  # field of clips of a `ConfidentDataset`
NAME = "name"  # field of a clip: its data set, sequence and frames
BROKEN = "broken"  # field of a clip that took the place of a broken one: what was wrong with that
# So many clips in a row are broken only if nearly all of those sequences are.
_MOST_REPLACEMENTS = 16
_SHOWN = 16


class ClipReader:
    """Reads example `index` of one data set in one size; a class, so that worker processes can unpickle it."""

    def __init__(
        self,
        name: str,
        dataset: Dataset,
        sampler: Sampler,
        size: Size,
        seed: int,
        augmentation: ColourAugmentation | None,
        min_valid_depth: float,
    ) -> None:
        self.name, self.dataset, self.sampler, self.size, self.seed = name, dataset, sampler, size, seed
        self.augmentation, self.min_valid_depth = augmentation, min_valid_depth

    def __call__(self, index: int, sequence: str) -> dict[str, Any]:
        rng = example_rng(self.seed, index)
        indices = [int(i) for i in self.sampler.draw(self.dataset, sequence, rng)]
        where = f"{self.name}, {sequence}, frames {' '.join(map(str, indices))}"
        if isinstance(self.dataset, DrawnOnDevice):
            return {**self.dataset.describe(sequence, indices), NAME: where}
        # One frame at a time: a clip of large pictures would take a gigabyte.
        frames = (self.dataset.read(sequence, [index]) for index in indices)
        clip = fit_each(frames, len(indices), self.size)
        check_frames(clip, where)
        valid = np.count_nonzero(clip.depth > 0) / clip.depth.size
        if valid < self.min_valid_depth:
            raise InputError(
                f"{where}: {valid:.2%} of the pixels have depth, min_valid_depth={self.min_valid_depth:g} asks for more"
            )
        if self.augmentation is not None:
            self.augmentation(clip.images, rng)
        fields = {name: getattr(clip, name) for name in FIELDS}
        if isinstance(self.dataset, ConfidentDataset):
            fields[CONFIDENCE] = self.dataset.confidence(sequence, indices)
            if fields[CONFIDENCE].shape != clip.depth.shape:
                raise InputError(
                    f"{where}: labels of {fields[CONFIDENCE].shape[1:]} for clips of {self.size}: use one size"
                )
        return {**fields, NAME: where}


class ReplaceBroken:
    """Reads from the first of `streams`; where that fails, the clip of the next index takes the clip's place.

    Where many in a row fail, the next stream goes on from the same index. A stream is a reader with its sequences,
    index to name; all have one size.
    """

    def __init__(self, streams: Sequence[tuple[ClipReader, grain.MapDataset]]) -> None:
        self.streams = tuple(streams)

    def __call__(self, index: int, sequence: str) -> dict[str, Any]:
        broken: list[str] = []
        for read, sequences in self.streams:
            for position in range(index, index + _MOST_REPLACEMENTS):
                try:
                    # Of the clips passed over, later ones are reported in their own turn.
                    return {**read(position, sequences[position]), BROKEN: broken[:1]}
                # Whatever a decoder raises: a run of a week is not to end for one file.
                except Exception as error:
                    broken.append(describe(error))
        names = ", ".join(dict.fromkeys(read.name for read, _ in self.streams))
        height, width = self.streams[0][0].size
        raise InputError(
            f"{names}, pictures for {height} x {width}: {len(broken)} clips in a row are broken: "
            f"{'; '.join(list(dict.fromkeys(broken))[:_SHOWN])}"
        )
