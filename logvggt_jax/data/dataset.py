"""What every reader offers, and the checks that its frames pass before they reach a model."""

import abc
import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from logvggt_jax.errors import InputError
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import is_rotation


class Dataset(Protocol):
    """Posed frames with depth, in named sequences.

    Frames that count have an image, a calibration and a finite pose; they are numbered 0 … num_frames - 1 in
    time order. Sets without poses give NaN extrinsics and keep their frames.
    """

    @property
    def sequences(self) -> Sequence[str]:
        """Unique sequence names."""
        ...

    @property
    def identity(self) -> Mapping[str, Any]:
        """What decides the frames of a sequence besides the set's files and the sequence's name; JSON values."""
        ...

    def num_frames(self, sequence: str) -> int:
        """Number of frames of `sequence` that count."""
        ...

    def image_size(self, sequence: str) -> tuple[int, int]:
        """(H, W) of the pictures of `sequence`."""
        ...

    def frame_names(self, sequence: str) -> Sequence[str]:
        """Unique names of these frames, in time order."""
        ...

    def read(self, sequence: str, indices: Sequence[int]) -> Frames:
        """Frames `indices` of `sequence`, in the order asked for."""
        ...

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """World-to-camera [T, 4, 4] float32 of a second set of true poses, from structure from motion.

        NaN for single frames that it lacks; None where there is no such set.
        """
        ...


@runtime_checkable
class DrawnOnDevice(Protocol):
    """A data set whose frames for training are described on the host and drawn on the device.

    They are not checked as pictures that were read are: all of them have to be what `check_frames` asks for.
    """

    def describe(self, sequence: str, indices: Sequence[int]) -> dict[str, np.ndarray]:
        """What frames `indices` of `sequence` are drawn from; shapes depend on the number of frames alone."""
        ...

    @property
    def draw(self) -> Callable[[Any], Any]:
        """A pure JAX function from descriptions with a leading axis of clips to the arrays of a batch."""
        ...


@runtime_checkable
class ConfidentDataset(Protocol):
    """A data set of labels, which says how far its depth is to be trusted; its frames have the size that they are
    trained at."""

    @property
    def labelled_by(self) -> str:
        """A digest of what the labels are of, besides the pictures."""
        ...

    def confidence(self, sequence: str, indices: Sequence[int]) -> np.ndarray:
        """[T, H, W] float32, at least 1, for frames `indices` of `sequence`."""
        ...


@dataclass(frozen=True)
class About:
    """What people need to know of a data set before they fetch it.

    "Inferred" and "unknown" are meant: nobody read it in the set's own documents.
    """

    source: str  # how one gets it
    licence: str  # its terms
    size: str  # bytes and counts, as far as known
    roles: tuple[str, ...]  # `training`, `evaluation` or both; as in the paper, where it has the set
    extra: str | None = None  # extra of this package that its files need; None = none


TRAINING, EVALUATION = "training", "evaluation"
LICENCE_NOT_READ = "not read for this list: see the set's site"


class Reader(Dataset):
    """A `Dataset` that says what it is, made from its folder (where it needs one), a split, and options of its own.

    The methods with a body are what other parts ask of every set; here as most sets answer.

    Attributes:
      name: as in `DATASETS`.
      title: as its owners write it.
      expects: what the root folder should hold.
      metric: whether lengths are metres.
      splits: those of `train`, `val`, `test` and `all` that it has.
      about: where it comes from.
      needs_root: whether it lies in a folder, the constructor's argument `root`; the others are made when read.
      own: whether it is a form of recordings of one's own: sequences have their folders' names, which others may have.
      truth: whether its frames have poses and depth, which training without a teacher needs.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    expects: ClassVar[str]
    metric: ClassVar[bool]
    splits: ClassVar[tuple[str, ...]]
    about: ClassVar[About]
    needs_root: ClassVar[bool] = True
    own: ClassVar[bool] = False
    truth: ClassVar[bool] = True
    sequences: Sequence[str] = ()

    @property
    @abc.abstractmethod
    def identity(self) -> Mapping[str, Any]:
        """As of `Dataset`."""

    @classmethod
    def size_options(cls, image_size: tuple[int, int]) -> Mapping[str, Any]:
        """The options with which pictures are made at `image_size` (H, W); none where they have the size they have."""
        return {}

    def for_training(self, *, cache_dir: str | Path | None, progress: bool) -> Dataset:
        """The set in the form in which training reads it over and over.

        What has to be made for that is kept in the folder `cache_dir`, in memory if None; `progress` shows it.
        """
        return self

    def training_split(self) -> "Reader | None":
        """The training split with pictures alike, where it is always at hand; None for a copy on disk."""
        return None

    def sfm_extrinsics(self, sequence: str, indices: Sequence[int]) -> np.ndarray | None:
        """As of `Dataset`."""
        return None

    def content_digest(self, sequence: str) -> str:
        """What tells the frames of `sequence` from those of a copy that was corrected since, and not where it lies.

        Empty where the `identity` and the sequence's name decide everything.
        """
        return ""


def check_split(split: str, reader: Reader) -> None:
    """Raises InputError unless `reader` has `split`."""
    if split not in reader.splits:
        raise InputError(f"{reader.title} has no split {split!r}: choose one of {', '.join(reader.splits)}")


def check_sequence(sequence: str, sequences: Collection[str], where: str) -> None:
    """Raises KeyError naming the data set `where` unless it has `sequence`."""
    if sequence not in sequences:
        known = ", ".join(list(sequences)[:3])
        raise KeyError(f"{where} has no sequence {sequence!r}; it has {len(sequences)}, for example {known}")


def check_indices(indices: Sequence[int], num_frames: int, where: str) -> list[int]:
    """`indices` as a list of integers; raises IndexError naming `where` for none, for one outside [0, num_frames), and
    for what is no whole number, such as a mask or a time."""
    checked = []
    for given in indices:
        try:
            number = None if isinstance(given, bool) else operator.index(given)
        except TypeError:
            number = None
        if number is None:
            raise IndexError(f"{where}: {given!r} is no frame's number; give whole numbers from 0 to {num_frames - 1}")
        checked.append(number)
    if not checked:
        raise IndexError(f"{where}: no frame indices given; ask for at least one of 0 … {num_frames - 1}")
    for index in checked:
        if not 0 <= index < num_frames:
            raise IndexError(f"{where}: frame {index} does not exist; indices go from 0 to {num_frames - 1}")
    return checked


def check_frames(frames: Frames, where: str, *, poses: bool = True) -> None:
    """Raises an error that names `where` and the frame unless `frames` can be trained or evaluated on.

    Checked: shapes and dtypes as `Frames` documents them, depth finite and not negative, intrinsics finite with
    positive focal lengths, extrinsics finite and rigid (rotation orthonormal to 1e-3, determinant +1).

    Args:
      frames: what a data set handed out.
      where: data set and sequence, for messages.
      poses: whether poses are needed. If not, extrinsics may be NaN throughout, as those of sets without poses are;
        extrinsics of which only a part is NaN are refused all the same.

    Raises:
      ValueError: wrong shapes or dtypes.
      InputError: wrong values.
    """
    if frames.images.ndim != 4 or frames.images.shape[3] != 3 or frames.images.dtype != np.uint8:
        raise ValueError(f"{where}: images must be uint8 [T, H, W, 3], got {frames.images.dtype} {frames.images.shape}")
    count, height, width = frames.images.shape[:3]
    expected = {"depth": (count, height, width), "intrinsics": (count, 3, 3), "extrinsics": (count, 4, 4)}
    for name, shape in expected.items():
        array = getattr(frames, name)
        if array.shape != shape or array.dtype != np.float32:
            raise ValueError(f"{where}: {name} must be float32 {shape}, got {array.dtype} {array.shape}")
    focal = frames.intrinsics[:, (0, 1), (0, 1)]
    rotation = np.nan_to_num(frames.extrinsics[:, :3, :3].astype(np.float64), posinf=0.0, neginf=0.0)
    checks = {
        "depth must be finite": np.isfinite(frames.depth).all((1, 2)),
        "depth must not be negative (0 marks invalid pixels)": (frames.depth >= 0).all((1, 2)),
        "intrinsics must be finite with positive focal lengths": np.isfinite(frames.intrinsics).all((1, 2))
        & (focal > 0).all(1),
    }
    pose_checks = {
        "extrinsics must be finite": np.isfinite(frames.extrinsics).all((1, 2)),
        "extrinsics must hold rotations (R^T R = I to 1e-3, determinant +1)": is_rotation(rotation),
    }
    if poses or not np.isnan(frames.extrinsics).all():
        checks |= pose_checks
    for requirement, passed in checks.items():
        if not passed.all():
            frame = int(np.argmin(passed))
            raise InputError(f"{where}: {requirement}; frame {frame} of this read fails: repair or drop that frame")
