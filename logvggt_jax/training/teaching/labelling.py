"""A teacher's labels for the clips of a data set: what the cache does not hold yet is labelled, by all processes."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from absl import logging
from rich.console import Console
from rich.progress import Progress

from logvggt_jax.data.dataset import Dataset, DrawnOnDevice
from logvggt_jax.data.feeding.broken_clips import describe
from logvggt_jax.data.feeding.frame_range import longest
from logvggt_jax.data.feeding.transforms import fit_each, nearest_size
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.training.config import TeacherConfig
from logvggt_jax.training.parallel.agreement import any_process, check_agreement, from_all
from logvggt_jax.training.teaching.labels import DIGEST_BYTES, is_labelled, label_digest, label_folder, write_labels
from logvggt_jax.training.teaching.taught import Size, TaughtClip, TaughtDataset
from logvggt_jax.training.teaching.teacher import Teacher


def taught(
    name: str,
    dataset: Dataset,
    teacher: Teacher,
    config: TeacherConfig,
    sizes: Sequence[Size],
    cache: Path,
    *,
    progress: bool = False,
    most: int | None = None,
) -> TaughtDataset:
    """The data set as its teacher sees it; labels the clips that `cache` does not hold yet, at `most` so many of all.

    Every sequence is cut into clips of `config.clip_length` frames, `config.stride` apart, the last one ending where
    the sequence ends; of several `sizes` (H, W) they have the one nearest to the pictures' aspect. Of several processes
    each reads and labels its share and tells the others, so that all have the same clips; all have to call this. A
    clip whose pictures cannot be read has no labels, and a warning names it: it stays, as a broken clip, so that the
    others keep their places whatever can be read.

    Raises InputError where no clip has labels, for a data set that is drawn on the device, and on every process where
    one of them fails or sees other sequences.
    """
    if isinstance(dataset, DrawnOnDevice):
        raise InputError(
            f"{name} is drawn on the device (renderer='device'), where a teacher does not see it: use 'host'"
        )
    wanted = list(itertools.islice(_cut(dataset, config), most))
    check_agreement(f"{name}: the sequences", [[sequence, *frames] for sequence, frames in wanted])
    # Of each clip: the number of its size, the first where it is unknown; whether it has labels; their digest.
    found = np.zeros((len(wanted), 2 + DIGEST_BYTES), np.uint8)
    failure: InputError | None = None
    console = Console(stderr=True, quiet=not progress)
    try:
        with Progress(console=console, transient=True) as bar:
            share = range(jax.process_index(), len(wanted), jax.process_count())
            for place in bar.track(share, description=f"Labelling clips of {name}"):
                sequence, frames = wanted[place]
                try:
                    size = nearest_size(dataset.image_size(sequence), sizes)
                    found[place, 0] = list(sizes).index(size)
                    images = fit_each((dataset.read(sequence, [i]) for i in frames), len(frames), size).images
                except Exception as error:  # of a decoder: one damaged picture is not to end a run of a week
                    where = f"{name}, {sequence}@{frames[0]}"
                    logging.warning("%s: a broken clip, its pictures cannot be read: %s", where, describe(error))
                    continue
                digest = label_digest(images, teacher.digest)
                folder = label_folder(cache, digest)
                if not is_labelled(folder, images.shape):
                    write_labels(folder, teacher.label(images))
                found[place, 1:] = [1, *digest]
    except InputError as error:
        failure = error
        if jax.process_count() > 1:  # which may label for hours before this one can end
            logging.error(
                "%s: %s; this process waits until the others have labelled their clips", name, one_line(error)
            )
    # Whoever has failed: the others wait for its clips.
    if any_process(failure is not None):
        raise failure or InputError(f"{name}: another process cannot label its clips; its output says why")
    clips: dict[str, TaughtClip] = {}
    for (sequence, frames), (size_number, has_labels, *digest) in zip(wanted, from_all(found).max(0), strict=True):
        labels = label_folder(cache, bytes(digest)) if has_labels else None
        clips[f"{sequence}@{frames[0]}"] = TaughtClip(sequence, frames, sizes[size_number], labels)
    if all(clip.labels is None for clip in clips.values()):
        raise InputError(
            f"{name}: no clip of two frames or more that can be read in {len(dataset.sequences)} sequences, nothing to "
            f"be taught on; {longest(dataset)}"
        )
    return TaughtDataset(dataset, clips, teacher.digest)


def unlabelled(dataset: Dataset, config: TeacherConfig) -> TaughtDataset:
    """The clips that `taught` would label, for whoever asks how many there are and how long: none can be read."""
    clips = {
        f"{sequence}@{frames[0]}": TaughtClip(sequence, frames, dataset.image_size(sequence), Path())
        for sequence, frames in _cut(dataset, config)
    }
    return TaughtDataset(dataset, clips, teacher="")


def _cut(dataset: Dataset, config: TeacherConfig) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Sequence and frames of every clip."""
    span = (config.clip_length - 1) * config.stride + 1
    for sequence in dataset.sequences:
        count = dataset.num_frames(sequence)
        last = max(count - span, 0)
        for start in sorted({*range(0, last + 1, span), last}):
            frames = tuple(range(start, min(start + span, count), config.stride))
            if len(frames) > 1:
                yield sequence, frames
