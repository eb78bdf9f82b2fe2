"""Clips of videos with a teacher's labels in the place of the truth, kept on disk.

    <cache>/teacher/<digest>/   of one clip: depth.npy, confidence.npy, intrinsics.npy, extrinsics.npy

The digest is of the clip's pictures, as the teacher saw them, and of the teacher: what has been labelled once is never
labelled again, by whatever run, and never taken for something else.
"""

import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import logging
from rich.console import Console
from rich.progress import Progress

from logvggt_jax.data.dataset import Dataset, DrawnOnDevice, check_indices, check_sequence
from logvggt_jax.data.feeding.broken_clips import describe
from logvggt_jax.data.feeding.transforms import fit, fit_each, nearest_size
from logvggt_jax.errors import InputError, OutputExists
from logvggt_jax.files import atomic_folder
from logvggt_jax.frames import Frames
from logvggt_jax.training.config import TeacherConfig
from logvggt_jax.training.parallel.joining import any_process, check_agreement, from_all
from logvggt_jax.training.teaching.teacher import Labels, Teacher

Size = tuple[int, int]
_DIGEST_BYTES = 16


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
        labels = _stored(clip.labels)
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
        return _stored(clip.labels).confidence[check_indices(indices, len(clip.frames), sequence)]

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """As of `Dataset`."""
        return None

    def _clip(self, sequence: str) -> TaughtClip:
        check_sequence(sequence, self._clips, "the teacher's clips")
        return self._clips[sequence]


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
    clip whose pictures cannot be read is left out, with a warning that names it.

    Raises InputError where no clip is left, for a data set that is drawn on the device, and on every process where one
    of them fails or sees other sequences.
    """
    if isinstance(dataset, DrawnOnDevice):
        raise InputError(
            f"{name} is drawn on the device (renderer='device'), where a teacher does not see it: use 'host'"
        )
    wanted = list(itertools.islice(_cut(dataset, config), most))
    check_agreement(f"{name}: the sequences", [[sequence, *frames] for sequence, frames in wanted])
    found = np.zeros((len(wanted), 1 + _DIGEST_BYTES), np.uint8)
    failure: InputError | None = None
    console = Console(stderr=True, quiet=not progress)
    try:
        with Progress(console=console, transient=True) as bar:
            share = range(jax.process_index(), len(wanted), jax.process_count())
            for place in bar.track(share, description=f"Labelling clips of {name}"):
                sequence, frames = wanted[place]
                try:
                    size = nearest_size(dataset.image_size(sequence), sizes)
                    images = fit_each((dataset.read(sequence, [i]) for i in frames), len(frames), size).images
                except Exception as error:  # of a decoder: one damaged picture is not to end a run of a week
                    where = f"{name}, {sequence}@{frames[0]}"
                    logging.warning("%s: left out, its pictures cannot be read: %s", where, describe(error))
                    continue
                digest = _digest(images, teacher)
                folder = _folder(cache, digest)
                if not _is_whole(folder, images.shape):
                    _write(folder, teacher.label(images))
                found[place] = [1 + list(sizes).index(size), *digest]
    except InputError as error:
        failure = error
    # Whoever has failed: the others wait for its clips.
    if any_process(failure is not None):
        raise failure or InputError(f"{name}: another process cannot label its clips; its output says why")
    clips = {
        f"{sequence}@{frames[0]}": TaughtClip(sequence, frames, sizes[row[0] - 1], _folder(cache, row[1:].tobytes()))
        for (sequence, frames), row in zip(wanted, from_all(found).max(0), strict=True)
        if row[0]
    }
    if not clips:
        raise InputError(f"{name}: no clip of two frames or more that can be read, nothing to be taught on")
    return TaughtDataset(dataset, clips, teacher.digest)


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


def _digest(images: np.ndarray, teacher: Teacher) -> bytes:
    found = hashlib.sha256(f"1 {teacher.digest} {images.shape}".encode())
    found.update(np.ascontiguousarray(images).data)
    return found.digest()[:_DIGEST_BYTES]


def _folder(cache: Path, digest: bytes) -> Path:
    return cache / "teacher" / digest.hex()


def _write(folder: Path, labels: Labels) -> None:
    try:
        with atomic_folder(folder, replace=folder.exists()) as fresh:
            for name, values in labels._asdict().items():
                np.save(fresh / f"{name}.npy", values)
    except OutputExists:  # another run labelled the same clip in the meantime
        return


def _stored(folder: Path) -> Labels:
    """Labels that are read from the disk where they are used; InputError naming what is missing or damaged."""
    arrays = []
    for name in Labels._fields:
        path = folder / f"{name}.npy"
        try:
            arrays.append(np.load(path, mmap_mode="r", allow_pickle=False))
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path}: cannot be read ({error}): start the run again, which labels the clip") from error
    return Labels(*arrays)


def _is_whole(folder: Path, shape: tuple[int, ...]) -> bool:
    try:
        labels = _stored(folder)
    except InputError:
        return False
    frames = shape[0]
    expected = (shape[:3], shape[:3], (frames, 3, 3), (frames, 4, 4))
    return tuple(values.shape for values in labels) == expected
