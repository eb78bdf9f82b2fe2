"""What readers of data sets on disk share: sequences and frames listed once, pictures opened when asked for."""

import abc
import contextlib
import hashlib
import io
import json
import os
from collections import Counter, OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from absl import logging

from logvggt_jax.data.dataset import Reader, check_indices, check_sequence, check_split
from logvggt_jax.data.errors import EmptySequence, MissingFiles, UnequalSizes
from logvggt_jax.data.formats.calibration import check_intrinsics
from logvggt_jax.data.formats.image import read_depth
from logvggt_jax.data.formats.lens import Lens
from logvggt_jax.data.formats.source_files import SourceFiles, file_glimpse, file_state, refused
from logvggt_jax.data.readers.listing_index import ListingIndex, code_digest
from logvggt_jax.errors import InputError
from logvggt_jax.files import numpy_reading
from logvggt_jax.frames import Frames

NO_POSES = np.full((4, 4), np.nan)
# Listings kept in memory; a set of twenty thousand sequences would fill it with all of them.
_RECENT = 64
INDOORS = (0.05, 50.0)  # metres, `plausible_depth` of rooms, halls and tables
_GAPS = (30, 10, 5, 2, 1)
_UNCOMPRESSED = (".bin", ".dpt", ".pfm")  # as large as before where another depth is written


@dataclass(frozen=True)
class FrameRecord:
    """One frame before its pictures are opened."""

    name: str  # unique in its sequence
    image: Path  # colour picture
    depth: Path  # depth in the set's own encoding; the picture itself for a frame without depth
    intrinsics: np.ndarray  # [3, 3] float64, pixels as the set's reader needs them (its `_read_frame` decides)
    extrinsics: np.ndarray  # [4, 4] float64, world-to-camera, rigid; NaN in sets without poses
    companion: Path | None = None  # a third file that the frame needs, such as a mask of valid depth
    calibration: Path | None = None  # the file that the intrinsics are from, for messages; None: constants of the set
    depth_scale: float = 1.0  # factor on the stored depth, where frames differ
    quarter_turns: int = 0  # counter-clockwise quarter turns from the stored picture to the one handed out
    lens: np.ndarray = field(default_factory=lambda: Lens().row)  # of the stored picture, as `Lens.row` has it


_FIELDS = tuple(each.name for each in fields(FrameRecord))
_PATHS = ("image", "depth", "companion", "calibration")


class Dropped(NamedTuple):
    """A frame that does not count, and why: `no pose`, for example."""

    reason: str
    file: Path | None = None  # that says so, where one is to be named


def frame(
    image: Path, depth: Path, intrinsics: np.ndarray, extrinsics: np.ndarray | None, **others: Any
) -> FrameRecord | Dropped:
    """The record of a frame, `others` being fields of it; dropped without a pose or without finite intrinsics."""
    if extrinsics is None:
        return Dropped("no pose")
    if not np.isfinite(intrinsics).all():
        return Dropped("no intrinsics", others.get("calibration"))
    others = {"name": image.stem, **others}
    return FrameRecord(image=image, depth=depth, intrinsics=intrinsics, extrinsics=extrinsics, **others)


def read_depth_of(record: FrameRecord, image: np.ndarray, units: float) -> np.ndarray:
    """Depth [h, w] float32 of a frame whose file is 16-bit with so many `units` a metre.

    A picture in depth's place stands for no depth: it is 0 throughout, of the size of `image` [H, W, 3].
    """
    if record.depth == record.image:
        return np.zeros(image.shape[:2], np.float32)
    return read_depth(record.depth).astype(np.float32) / np.float32(units)


@dataclass(frozen=True)
class Listing:
    """The frames of a sequence that count, in time order, and how many were dropped, by reason (`no pose`)."""

    frames: Sequence[FrameRecord]
    dropped: Mapping[str, int]


class FolderDataset(Reader):
    """A `Dataset` in a folder.

    A reader says in `_find_sequences` which sequences a split has, in `_frames` which frames a sequence has, and in
    `_read_frame` how one frame is decoded. Both listings are kept in an index (see `listing_index`), for which they
    read folders and text files through `SourceFiles`.

    Attributes:
      plausible_depth: metres between which the median of a frame's depth lies, in metric sets; for checks of a copy.
      centred: whether principal points lie near the picture's centre; for checks of a copy.
    """

    plausible_depth: ClassVar[tuple[float, float]] = (0.01, 1000.0)
    centred: ClassVar[bool] = True

    def __init__(self, root: str | Path, split: str = "all") -> None:
        """Lists the sequences of a `split` in the set's folder `root`; frames are listed when a sequence is first used.

        Raises MissingFiles where there is no such folder, nothing of the set in it, or a list file is missing;
        InputError for a split that the set does not have, or a damaged list file.
        """
        check_split(split, self)
        self.root, self.split = Path(root), split
        try:
            is_folder = self.root.is_dir()
        except OSError as error:
            raise refused(self.root, error) from error
        if not is_folder:
            raise MissingFiles(f"{self.root}: no such folder; pass the folder that holds {self.expects}")
        self._index = ListingIndex(self.identity, self.root, code_digest(type(self)))
        self._recent: OrderedDict[str, Listing] = OrderedDict()
        self._counts: dict[str, int] = {}
        self._places = self._listed_sequences()
        if not self._places:
            raise MissingFiles(f"{self.root}: no sequences of {self.title}; expected {self.expects}")
        self.sequences: tuple[str, ...] = tuple(self._places)

    @property
    def identity(self) -> dict[str, Any]:
        """The set's name, and what besides the folder and the sequence's name decides its frames; JSON values."""
        return {"name": self.name}

    def num_frames(self, sequence: str) -> int:
        """Frames with a picture, depth, a calibration and (where the set has poses) a finite pose."""
        if sequence not in self._counts:
            check_sequence(sequence, self._places, self.title)
            count = self._index.count(f"frames {sequence}")
            self._counts[sequence] = len(self._listing(sequence).frames) if count is None else count
        return self._counts[sequence]

    def image_size(self, sequence: str) -> tuple[int, int]:
        """(H, W) of the pictures handed out, as the first frame has them; kept in the index.

        Where that frame cannot be read, one in the middle and the last one are tried before its error is raised.
        """
        records = self._listing(sequence).frames
        key = f"size {sequence} {records[0].quarter_turns}"
        payload = self._index.get(key)
        if payload is not None:
            height, width = json.loads(payload)
            return height, width
        failed: Exception | None = None
        for position in dict.fromkeys((0, len(records) // 2, len(records) - 1)):
            try:
                height, width = self.read(sequence, [position]).images.shape[1:3]
            except (OSError, ValueError) as error:
                failed = failed or error
                continue
            files = SourceFiles()
            files.exists(records[position].image)
            self._index.put(key, json.dumps([height, width]).encode(), 1, files)
            return height, width
        assert failed is not None
        raise failed

    def frame_names(self, sequence: str) -> list[str]:
        """Names of these frames, in time order."""
        return [record.name for record in self._listing(sequence).frames]

    def record(self, sequence: str, index: int) -> FrameRecord:
        """The files of a frame, and what is known of it before they are opened."""
        return self._listing(sequence).frames[index]

    def dropped_frames(self, sequence: str) -> dict[str, int]:
        """Frames of the folder that do not count, by reason."""
        return dict(self._listing(sequence).dropped)

    def extrinsics(self, sequence: str) -> np.ndarray:
        """World-to-camera [T, 4, 4] float32 of these frames, as `read` gives them; no picture is opened."""
        return np.stack([record.extrinsics for record in self._listing(sequence).frames]).astype(np.float32)

    def content_digest(self, sequence: str) -> str:
        """As of `Reader`: of what is known of the frames before their pictures are opened, poses and calibrations
        among it, of the number of bytes of their files and, where depth is not compressed, of some of these, and of
        poses from structure from motion."""
        records = self._listing(sequence).frames
        digest = hashlib.sha256()
        for record in records:
            paths = [path for path in (record.image, record.depth, record.companion) if path is not None]
            files = [(os.path.relpath(path, self.root), file_state(path)[1]) for path in paths]
            digest.update(repr((record.name, files, record.depth_scale, record.quarter_turns)).encode())
            if record.depth.suffix in _UNCOMPRESSED:
                digest.update(file_glimpse(record.depth))
            digest.update(np.concatenate([record.intrinsics.ravel(), record.extrinsics.ravel(), record.lens]).tobytes())
        sfm = self.sfm_extrinsics(sequence, range(len(records)))
        digest.update(b"" if sfm is None else sfm.tobytes())
        return digest.hexdigest()[:24]

    def neighbours(self, sequence: str, index: int) -> list[int]:
        """Frames that may see what frame `index` sees, those seen from farther away first.

        Here those 30, 10, 5, 2 and 1 later in the video, or as much earlier at its end.
        """
        count = self.num_frames(sequence)
        frames = [index + gap if index + gap < count else index - gap for gap in _GAPS]
        return [frame for frame in frames if frame >= 0]

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Frames `indices`, in the order asked for.

        Raises InputError naming the file: a missing, truncated or damaged picture, a wrong type,
        sizes that do not belong together, intrinsics that cannot belong to the picture (naming the file that they are
        from), no permission.
        """
        records = self._listing(sequence).frames
        chosen = [records[i] for i in check_indices(indices, len(records), f"{self.title}, {sequence}")]
        images: list[np.ndarray] = []
        depths: list[np.ndarray] = []
        intrinsics: list[np.ndarray] = []
        for record in chosen:
            try:
                image, depth, matrix = self._read_frame(record)
            except InputError:
                raise
            except OSError as error:
                raise refused(error.filename or record.image, error) from error
            if record.quarter_turns:
                image, depth = np.rot90(image, record.quarter_turns), np.rot90(depth, record.quarter_turns)
            if depth.shape != image.shape[:2]:
                mend = "bring it to that, each pixel with its nearest's depth" if self.own else "fetch both again"
                raise UnequalSizes(
                    f"{record.depth}: size {depth.shape} differs from {image.shape[:2]} of {record.image.name}: "
                    f"depth must have the picture's size; {mend}"
                )
            if images and image.shape != images[0].shape:
                mend = "make those of another size a recording of their own" if self.own else "fetch both again"
                raise UnequalSizes(
                    f"{record.image}: size {image.shape[:2]} differs from {images[0].shape[:2]} of "
                    f"{chosen[0].image.name}: frames of one sequence must have one size; {mend}"
                )
            check_intrinsics(matrix, image.shape[:2], record.image, record.calibration)
            images.append(image)
            depths.append(_valid(depth))
            intrinsics.append(matrix)
        return Frames(
            images=np.stack(images),
            depth=np.stack(depths),
            intrinsics=np.stack(intrinsics).astype(np.float32),
            extrinsics=np.stack([record.extrinsics for record in chosen]).astype(np.float32),
            metric=self.metric,
        )

    @abc.abstractmethod
    def _find_sequences(self, files: SourceFiles) -> Mapping[str, Path]:
        """Unique names of the split's sequences, in a fixed order, each with its folder."""

    @abc.abstractmethod
    def _frames(self, sequence: str, folder: Path, files: SourceFiles) -> Iterable[FrameRecord | Dropped]:
        """The frames of one sequence in time order; raises naming the file for whatever is missing or damaged."""

    @abc.abstractmethod
    def _read_frame(self, record: FrameRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Picture [H, W, 3] uint8 RGB, z-depth [H, W] float, intrinsics [3, 3] float64.

        Depth is invalid where it is 0, negative or not finite.
        Before `record.quarter_turns` for picture and depth; the intrinsics are those after it.
        """

    def _listed_sequences(self) -> dict[str, Path]:
        key = f"sequences {self.split}"
        payload = self._index.get(key)
        if payload is not None:
            return {name: self.root / place for name, place in json.loads(payload).items()}
        files = SourceFiles()
        places = dict(self._find_sequences(files))
        relative = {name: os.path.relpath(place, self.root) for name, place in places.items()}
        self._index.put(key, json.dumps(relative).encode(), len(places), files)
        return places

    def _listing(self, sequence: str) -> Listing:
        check_sequence(sequence, self._places, self.title)
        recent = self._recent.get(sequence)
        if recent is not None:
            # Another thread may just have let it go.
            with contextlib.suppress(KeyError):
                self._recent.move_to_end(sequence)
            return recent
        key = f"frames {sequence}"
        payload = self._index.get(key)
        listing = None if payload is None else _unpacked(payload, self.root)
        if listing is None:
            files = SourceFiles()
            found = [_countable(each) for each in self._frames(sequence, self._places[sequence], files)]
            listing = Listing(
                frames=[each for each in found if isinstance(each, FrameRecord)],
                dropped=Counter(each.reason for each in found if isinstance(each, Dropped)),
            )
            if not listing.frames:
                culprit = next((each.file for each in found if isinstance(each, Dropped) and each.file), None)
                raise EmptySequence(
                    f"{self._places[sequence]}: no frame of {self.title} counts here "
                    f"(dropped: {dict(listing.dropped) or 'none'}{f'; see {culprit}' if culprit else ''}): "
                    f"{'add what they lack' if self.own else 'fetch the sequence again'} or remove its folder"
                )
            self._index.put(key, _packed(listing, self.root), len(listing.frames), files)
        self._recent[sequence] = listing
        if len(self._recent) > _RECENT:
            self._recent.popitem(last=False)
        return listing


def _countable(found: FrameRecord | Dropped) -> FrameRecord | Dropped:
    """Drops a frame whose numbers, finite in its files, are not in float32: it is lost like one that has none."""
    if isinstance(found, Dropped):
        return found
    for values, reason in ((found.extrinsics, "no pose"), (found.intrinsics, "no intrinsics")):
        with np.errstate(over="ignore"):
            delivered = values.astype(np.float32)
        # NaN throughout is meant: sets without poses, and calibrations that are read with the picture.
        if not np.isfinite(delivered).all() and not np.isnan(delivered).all():
            return Dropped(reason, found.calibration if reason == "no intrinsics" else None)
    return found


def _valid(depth: np.ndarray) -> np.ndarray:
    """Depth as float32, 0 where it is negative or not finite in that type."""
    with np.errstate(over="ignore"):
        depth = depth.astype(np.float32, copy=False)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))


def _packed(listing: Listing, root: Path) -> bytes:
    """A listing as the bytes of an npz file, a column for each field of its records."""
    columns: dict[str, Any] = {name: [getattr(record, name) for record in listing.frames] for name in _FIELDS}
    for name in _PATHS:
        columns[name] = ["" if path is None else _stored(path, root) for path in columns[name]]
    buffer = io.BytesIO()
    np.savez(buffer, dropped=json.dumps(dict(listing.dropped)), **columns)
    return buffer.getvalue()


def _stored(path: Path, root: Path) -> str:
    """A path that, joined to `root`, is the same file. Those of lists may lead out of it, and `..` after a link to a
    folder is not the folder before it."""
    return str(path.relative_to(root) if path.is_relative_to(root) else path.absolute())


def _unpacked(payload: bytes, root: Path) -> Listing | None:
    """The listing that `_packed` stored; None where its bytes are damaged, which SQLite does not notice."""
    try:
        with numpy_reading(), np.load(io.BytesIO(payload), allow_pickle=False) as packed:
            columns: dict[str, Any] = {name: packed[name] for name in _FIELDS}
            dropped = json.loads(str(packed["dropped"]))
    except (ValueError, OSError) as error:
        logging.warning("a damaged listing of %s is made anew (%r)", root, error)
        return None
    for name in _FIELDS:
        if columns[name].ndim == 1:  # Python's own values; matrices stay arrays
            columns[name] = columns[name].tolist()
    for name in _PATHS:
        columns[name] = [root / path if path else None for path in columns[name]]
    return Listing([FrameRecord(*row) for row in zip(*columns.values(), strict=True)], dropped)
