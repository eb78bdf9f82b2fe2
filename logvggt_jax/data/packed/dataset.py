"""A packed data set as the data set that was packed."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grain
import numpy as np

from logvggt_jax.data.dataset import Reader, check_indices, check_sequence, check_split
from logvggt_jax.data.errors import BrokenPicture, MissingFiles, UnequalSizes
from logvggt_jax.data.feeding.sampling import Covisibility
from logvggt_jax.data.packed.index import (
    MEND,
    PackedSequence,
    notes_file,
    read_index,
    read_json_object,
    shard_file,
)
from logvggt_jax.data.packed.records import read_record
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.frames import Frames

_RECENT = 16  # notes of shards that are kept


@dataclass(frozen=True)
class _WholeFile:
    """A shard as Grain takes it: its length is known, so that it is opened only when it is read."""

    filename: str
    take: int
    skip: int = 0

    @property
    def examples_in_shard(self) -> int:
        return self.take


class PackedDataset(Reader):
    """The frames of one data set, from the shards in `root`; made by `open_packed`.

    Frames, names, order and errors are those of the reader that was packed, bit for bit; so are the clips that training
    draws.
    """

    def __init__(self, root: Path, split: str, reader: type[Reader], options: Mapping[str, Any]) -> None:
        index = read_index(root)
        if index.name != reader.name:
            raise InputError(f"{root} holds {index.name}, packed, and not {reader.name}: give the data set that name")
        if dict(options) != index.options:
            raise InputError(
                f"{root} was packed with the options {index.options}, got {dict(options)}: give the same, or pack anew"
            )
        # As the class says of the reader that was packed.
        self.name, self.title, self.expects = reader.name, reader.title, reader.expects  # type: ignore[misc]
        self.metric, self.about, self.splits = index.metric, reader.about, reader.splits  # type: ignore[misc]
        check_split(split, self)
        if split not in index.splits:
            raise InputError(
                f"{root}: the copy that was packed had no lists for the split {split!r}, only {', '.join(index.splits)}"
            )
        self._root, self._packed_split, self._identity = root, index.split, index.identity
        # Of some sets a sequence has other frames in another split; of that one only names are known then.
        same = split == index.split or "split" not in index.identity
        self._places = {each.name: each for each in index.sequences if same}
        self.sequences: tuple[str, ...] = tuple(index.splits[split])
        for number, shard in enumerate(index.shards):
            path = shard_file(root, number)
            if not path.is_file():
                raise MissingFiles(f"{path}: no such file; {MEND}")
            if path.stat().st_size != shard.bytes:
                raise InputError(f"{path}: {path.stat().st_size} bytes, expected {shard.bytes}; {MEND}")
        files = [_WholeFile(str(shard_file(root, i)), shard.records) for i, shard in enumerate(index.shards)]
        self._before = [0, *np.cumsum([shard.records for shard in index.shards]).tolist()]
        self._records = grain.sources.ArrayRecordDataSource(files)
        self._recent: OrderedDict[int, dict[str, Any]] = OrderedDict()

    @property
    def identity(self) -> Mapping[str, Any]:
        """As of the reader that was packed."""
        return self._identity

    def num_frames(self, sequence: str) -> int:
        """As of `Dataset`; raises what the reader did where the sequence could not be listed."""
        return self._place(sequence).frames

    def image_size(self, sequence: str) -> tuple[int, int]:
        """As of `Dataset`."""
        size = self._place(sequence).size
        if size is None:
            raise BrokenPicture(f"{self._root}, {sequence}: none of its pictures could be read when it was packed")
        return size

    def frame_names(self, sequence: str) -> list[str]:
        """As of `Dataset`."""
        return list(self._notes(sequence)["frame_names"])

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """As of `Dataset`; InputError naming a shard that is damaged, or with the message of a frame that was."""
        place = self._place(sequence)
        chosen = check_indices(indices, place.frames, f"{self.title}, {sequence}")
        first = self._before[place.shard] + place.first
        frames = [self._frame(first + i, place) for i in chosen]
        for each in frames:
            if each.images.shape != frames[0].images.shape:
                raise UnequalSizes(
                    f"{self.title}, {sequence}: size {each.images.shape[1:3]} differs from "
                    f"{frames[0].images.shape[1:3]}: frames of one sequence must have one size; fetch both again"
                )
        return Frames(
            images=np.concatenate([each.images for each in frames]),
            depth=np.concatenate([each.depth for each in frames]),
            intrinsics=np.concatenate([each.intrinsics for each in frames]),
            extrinsics=np.concatenate([each.extrinsics for each in frames]),
            metric=self.metric,
        )

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """As of `Dataset`."""
        stored = self._notes(sequence).get("sfm_extrinsics")
        if stored is None:
            return None
        found = np.array(stored, np.float32)[check_indices(indices, self.num_frames(sequence), sequence)]
        return found if np.isfinite(found).any() else None

    def content_digest(self, sequence: str) -> str:
        """As of the reader that was packed."""
        return str(self._notes(sequence).get("content", ""))

    def _frame(self, record: int, place: PackedSequence) -> Frames:
        path = shard_file(self._root, place.shard)
        try:
            data = self._records[record]
        # The library has no errors of its own: RuntimeError for damage, others for files that are gone.
        except Exception as error:
            raise BrokenPicture(f"{path}: cannot be read ({one_line(error):.200}); {MEND}") from error
        try:
            return read_record(data, metric=self.metric)
        except InputError:
            raise
        except Exception as error:
            raise BrokenPicture(f"{path}: record of {place.name} is damaged ({one_line(error)}); {MEND}") from error

    def _place(self, sequence: str) -> PackedSequence:
        place = self._places.get(sequence)
        if place is None:
            if sequence in self.sequences:
                raise InputError(
                    f"{self._root}: {sequence} of this split is not here, the split {self._packed_split!r} was packed: "
                    "pack this one into another folder"
                )
            check_sequence(sequence, self._places, self.title)
        assert place is not None
        if place.error is not None:
            raise InputError(place.error)
        return place

    def _notes(self, sequence: str) -> dict[str, Any]:
        shard = self._place(sequence).shard
        notes = self._recent.get(shard)
        if notes is None:
            notes = self._recent[shard] = read_json_object(notes_file(self._root, shard))["sequences"]
            if len(self._recent) > _RECENT:
                self._recent.popitem(last=False)
        found: dict[str, Any] = notes[sequence]
        return found


class PackedWalks(PackedDataset):
    """A packed data set whose frames have no order in time."""

    def covisibility(self, sequence: str) -> Covisibility:
        """As of `CovisibleDataset`."""
        return {int(frame): [(i, score) for i, score in near] for frame, near in self._notes(sequence)["covisibility"]}


def open_packed(root: str | Path, split: str, reader: type[Reader], options: Mapping[str, Any]) -> PackedDataset:
    """The data set of `reader` that was packed into `root`.

    Raises InputError for another data set, split or options than was packed, and for a folder in which shards are
    missing or cut short; other damage shows when it is read, or when `logvggt data pack` is run again.
    """
    folder = Path(root)
    return (PackedWalks if read_index(folder).walks else PackedDataset)(folder, split, reader, options)
