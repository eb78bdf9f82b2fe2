"""Whether the sources of a run have poses and depth to learn from, said before anything is compiled."""

from collections.abc import Iterator, Mapping

import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.registry import READERS
from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames, evenly_spaced
from logvggt_jax.training.config import SourceConfig, TrainConfig

# Frames of a source that are looked at until one has depth: the first one nearly always.
_MOST_FRAMES = 100
_TEACHER = "--config=configs/distill.py:TEACHER"


def check_truth(config: TrainConfig) -> None:
    """Raises InputError where there is no teacher for sources that never have poses and depth."""
    validated = () if config.validation is None else config.validation.sources
    taught = (config.teacher is not None, config.teacher is not None and config.teacher.validation)
    for sources, teacher in zip((config.data.sources, validated), taught, strict=True):
        for source in sources:
            if not teacher and source.name in READERS and not READERS[source.name].truth:
                raise InputError(
                    f"{source.name} ({source.root}): {READERS[source.name].title} have no poses and no depth, which "
                    f"only a teacher gives them: {_TEACHER}, or a data set that has both"
                )


def check_depth(config: TrainConfig, datasets: Mapping[str, Dataset]) -> None:
    """Raises InputError where there is no teacher for a training source on the disk, of those in `datasets`, whose
    frames have no depth, or no poses.

    Up to a hundred frames are looked at, from all over the source. Those that cannot be read are passed over: their
    clips are broken, and counted.
    """
    if config.teacher is not None:
        return
    for source in config.data.sources:
        if source.root is not None and source.name in datasets:
            _check_source(source, datasets[source.name])


def _check_source(source: SourceConfig, dataset: Dataset) -> None:
    count, depth, poses = 0, False, False
    for frames in _some_frames(dataset):
        count += 1
        depth |= bool((frames.depth > 0).any())
        poses |= bool(np.isfinite(frames.extrinsics).all())
        if depth and poses:
            return
    if count:
        lacking = " and ".join(name for name, has in (("depth", depth), ("poses", poses)) if not has)
        raise InputError(
            f"{source.name} ({source.root}): none of the {count} frames that were looked at has {lacking}, which "
            f"training needs; expected {READERS[source.name].expects}. Add what is missing, or let a teacher give it: "
            f"{_TEACHER}"
        )


def _some_frames(dataset: Dataset) -> Iterator[Frames]:
    """Single frames, evenly spaced over the sequences and in each of them."""
    sequences = evenly_spaced(len(dataset.sequences), _MOST_FRAMES)
    for sequence in (dataset.sequences[i] for i in sequences):
        try:
            places = evenly_spaced(dataset.num_frames(sequence), _MOST_FRAMES // len(sequences))
        except Exception:  # of whatever kind a damaged listing raises
            continue
        for place in places:
            try:
                frames = dataset.read(sequence, [place])
            except Exception:  # of whatever kind a decoder raises
                continue
            yield frames
