"""Checks a copy of a data set: every sequence is listed, a sample of its frames (or all) decoded and compared."""

import os
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from logvggt_jax.data.checks.consistency import depth_consistency, visible_shares
from logvggt_jax.data.checks.mistakes import figures, mend
from logvggt_jax.data.checks.picture import check_picture_path, write_check_picture
from logvggt_jax.data.checks.plausibility import complaints
from logvggt_jax.data.checks.report import CheckReport, DepthRange, Problem, SequenceReport
from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.errors import NOT_THE_COPY, MissingFiles
from logvggt_jax.data.readers.folder_dataset import FolderDataset
from logvggt_jax.data.registry import READERS, open_dataset
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.frames import evenly_spaced

INCONSISTENT = 0.1
"""Relative difference above which depth, intrinsics and poses are said not to belong together.

In redkitchen of 7-Scenes, frames 30 apart differ by 0.006; with its poses read the wrong way round by 0.23."""

_SAMPLE = 5  # frames of a sequence that are decoded, evenly spread, the first and the last among them
_PAIRS = 3  # pairs of frames of a sequence that are compared
_MIN_VISIBLE = 0.5  # of a frame's pixels, for its partner
_MIN_COMPARED = 0.05  # a pair with less in common says nothing
_DRAWN = 4  # sequences in the picture
_BATCH = 64  # frames handed to threads at a time: Ctrl-C waits for no more


def check_copy(
    name: str,
    root: str | Path,
    *,
    split: str = "all",
    max_sequences: int | None = None,
    all_images: bool = False,
    picture: str | Path | None = None,
    progress: bool = False,
) -> CheckReport:
    """Walks the copy of data set `name` in folder `root` and reports what it holds and what is wrong with it.

    Damage never ends the walk: a sequence that cannot be listed (a file is missing, a calibration or pose is broken)
    is reported with its files and the next one is looked at; its pictures are first opened when that is mended. A frame
    that cannot be decoded is reported and the next one decoded. Frames that decode are looked at: blank pictures, depth
    in another unit and calibrations of another size are problems too (see `plausibility`).

    Args:
      name: one of `READERS`.
      root: the data set's folder.
      split: as in `open_dataset`.
      max_sequences: look at this many sequences, evenly spread; None = all.
      all_images: decode every frame instead of a sample of each sequence.
      picture: PNG file to write, with frames, their depth and a view of the cameras from above (needs matplotlib).
      progress: show a progress bar on stderr.

    Raises:
      InputError: unknown name or split, `max_sequences` below 1, or `picture` is no PNG file's name.
      MissingFiles: no such folder, nothing of the set in it, or its list of sequences is missing.
      MissingPackage: a package is missing that the set or the picture needs; names the extra that brings it.
    """
    if name in READERS and not READERS[name].needs_root:
        raise InputError(f"{name} are made when they are read: there is no copy to check")
    if max_sequences is not None and max_sequences < 1:
        raise InputError(f"max_sequences must be at least 1, got {max_sequences}")
    picture = None if picture is None else check_picture_path(picture)
    dataset = open_dataset(name, root, split)
    if not isinstance(dataset, FolderDataset):
        raise InputError(
            f"{root} is a packed data set: check the copy that was packed; `logvggt data pack` with this folder as its "
            "output verifies the shards"
        )
    chosen = dataset.sequences
    if max_sequences is not None and max_sequences < len(chosen):
        places = evenly_spaced(len(chosen), max_sequences) if max_sequences > 1 else [len(chosen) // 2]
        chosen = tuple(chosen[i] for i in places)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), disable=not progress) as bars,
        ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool,
    ):
        reports = [
            _check_sequence(dataset, sequence, all_images, pool)
            for sequence in bars.track(chosen, description=f"Sequences of {dataset.title}")
        ]
    report = CheckReport(
        name=name,
        title=dataset.title,
        root=str(root),
        split=split,
        metric=dataset.metric,
        sequences_in_split=len(dataset.sequences),
        sequences=reports,
    )
    if picture is not None:
        drawable = [sequence for sequence in reports if sequence.examples]
        if drawable:
            write_check_picture(picture, dataset, [drawable[i] for i in evenly_spaced(len(drawable), _DRAWN)])
        else:
            warnings.warn(f"{picture} is not written: no frame could be decoded", stacklevel=2)
    return report


@dataclass(frozen=True)
class _Frame:
    """What is kept of a decoded frame."""

    size: tuple[int, int]
    valid: int  # pixels
    depth: tuple[float, float, float] | None  # minimum, median, maximum
    complaints: tuple[tuple[str, str], ...]  # kind and message of what is implausible


class _Problems:
    """Problems of one sequence; the same message counts once."""

    def __init__(self, sequence: str) -> None:
        self._sequence = sequence
        self._found: dict[tuple[str, str], Problem] = {}

    def add(self, kind: str, message: str) -> None:
        self._found[kind, message] = Problem(kind, self._sequence, message)

    def add_error(self, error: Exception) -> None:
        """Files an error of a reader; one that is no fault of the copy is raised again."""
        if isinstance(error, NOT_THE_COPY):
            raise error
        if isinstance(error, MissingFiles) and error.reasons:
            for path, reason in error.reasons.items():
                self.add(error.kind, f"{path}: no such file, {reason}")
            return
        message = one_line(error)
        if isinstance(error, InputError):
            self.add(getattr(error, "kind", "damaged file"), message)
        elif isinstance(error, OSError):
            self.add("unreadable file", message)
        else:
            self.add("unexpected error", f"{self._sequence}: {type(error).__name__}: {message}")

    def all(self) -> tuple[Problem, ...]:
        return tuple(self._found.values())


def _check_sequence(
    dataset: FolderDataset, sequence: str, all_images: bool, pool: ThreadPoolExecutor
) -> SequenceReport:
    problems = _Problems(sequence)
    try:
        extrinsics = dataset.extrinsics(sequence)
        dropped = dataset.dropped_frames(sequence)
    except Exception as error:
        problems.add_error(error)
        return SequenceReport(sequence, problems=problems.all())
    count = len(extrinsics)
    has_poses = bool(np.isfinite(extrinsics).all())
    wanted = range(count) if all_images else evenly_spaced(count, _SAMPLE)
    frames = _decode(dataset, sequence, wanted, pool, problems)
    figure, compared, mended = None, None, None
    if has_poses:
        figure, compared, mended = _consistency(dataset, sequence, extrinsics, set(wanted) - set(frames), problems)
    if figure is not None and (figure > INCONSISTENT or mended):
        expected = f"median; up to {INCONSISTENT:.0%} expected"
        cause = "poses, intrinsics or depth belong to another sequence or another release: fetch the sequence again"
        if dataset.own:
            cause = (
                "direction or axes of the poses, the unit of depth or the calibration's picture size are not what "
                f"{dataset.title} have: compare them with the documentation"
            )
        problems.add(
            "inconsistent depth and poses",
            f"{dataset.root}, {sequence}: depth carried into another frame differs from the depth there by "
            f"{figure:.1%} ({f'it would by {mended}' if mended else expected}): {cause}",
        )
    decoded = list(frames)
    return SequenceReport(
        name=sequence,
        num_frames=count,
        dropped=dropped,
        has_poses=has_poses,
        decoded=len(decoded),
        without_depth=sum(frame.depth is None for frame in frames.values()),
        image_size=next((frame.size for frame in frames.values()), None),
        depth=_depth_range(frames.values()),
        consistency=figure,
        compared_share=compared,
        examples=[decoded[i] for i in sorted({len(decoded) // 4, 3 * len(decoded) // 4})] if decoded else [],
        problems=problems.all(),
    )


def _decode(
    dataset: FolderDataset, sequence: str, indices: Iterable[int], pool: ThreadPoolExecutor, problems: _Problems
) -> dict[int, _Frame]:
    """The frames that could be decoded, by index; of one size."""
    wanted, frames = list(indices), dict[int, _Frame]()
    for start in range(0, len(wanted), _BATCH):
        batch = wanted[start : start + _BATCH]
        for index, found in zip(batch, pool.map(_attempt(dataset, sequence), batch), strict=True):
            if isinstance(found, Exception):
                problems.add_error(found)
                continue
            first = next(iter(frames), index)
            if first == index or found.size == frames[first].size:
                frames[index] = found
                for kind, message in found.complaints:
                    problems.add(kind, message)
            else:
                try:  # The reader says which files differ.
                    dataset.read(sequence, [first, index])
                except Exception as error:
                    problems.add_error(error)
    return frames


def _attempt(dataset: FolderDataset, sequence: str) -> Callable[[int], _Frame | Exception]:
    names = dataset.frame_names(sequence)

    def decode(index: int) -> _Frame | Exception:
        try:
            frames = dataset.read(sequence, [index])
            where = f"{dataset.root}, {sequence}, frame {names[index]}"
            check_frames(frames, where, poses=bool(np.isfinite(frames.extrinsics).all()))
        except Exception as error:
            return error
        depth = frames.depth[0]
        valid = depth[depth > 0]
        statistics = (float(valid.min()), float(np.median(valid)), float(valid.max())) if valid.size else None
        found = tuple(complaints(dataset, dataset.record(sequence, index), frames))
        return _Frame((depth.shape[0], depth.shape[1]), valid.size, statistics, found)

    return decode


def _depth_range(frames: Iterable[_Frame]) -> DepthRange | None:
    frames = list(frames)
    ranges = np.array([frame.depth for frame in frames if frame.depth is not None])
    if not len(ranges):
        return None
    pixels = sum(frame.size[0] * frame.size[1] for frame in frames)
    return DepthRange(
        minimum=float(ranges[:, 0].min()),
        median=float(np.median(ranges[:, 1])),
        maximum=float(ranges[:, 2].max()),
        valid_share=sum(frame.valid for frame in frames) / pixels,
    )


def _consistency(
    dataset: FolderDataset, sequence: str, extrinsics: np.ndarray, broken: set[int], problems: _Problems
) -> tuple[float | None, float | None, str | None]:
    """Medians of difference and share over a few pairs of frames that are not known to be broken, None where no two
    see the same; and of own recordings what would mend the difference, if that is known."""
    compared, tried = [], []
    # Neither the first nor the last frame: those have neighbours on one side only.
    for index in sorted(set(evenly_spaced(len(extrinsics), _PAIRS + 2)[1:-1] or [0])):
        try:
            candidates = [frame for frame in dataset.neighbours(sequence, index) if frame not in broken]
            if index in broken or not candidates:
                continue
            seen = visible_shares(dataset.read(sequence, [index]), 0, extrinsics[candidates])
            # The first that sees enough; failing that, the one that sees most.
            partner = candidates[int(np.argmax(np.minimum(seen, _MIN_VISIBLE)))]
            pair = dataset.read(sequence, [index, partner])
            result = depth_consistency(pair, 0, 1)
        except Exception as error:
            problems.add_error(error)
            continue
        if result.share >= _MIN_COMPARED:
            compared.append(result)
            if dataset.own:
                tried.append(figures(pair))
    if not compared:
        return None, None, None
    difference, share = np.median(compared, axis=0)
    return float(difference), float(share), mend(np.stack(tried)) if tried else None
