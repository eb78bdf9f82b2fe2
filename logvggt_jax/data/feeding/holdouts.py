"""Sequences that evaluation uses and that training must therefore never see.

ScanNet, Co3Dv2 and Virtual KITTI are trained on and evaluated on; they are divided by scene. The other evaluation
sets are not trained on at all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.frame_range import FrameRange, shared_frames
from logvggt_jax.errors import InputError

_SHOWN = 10


@dataclass(frozen=True)
class HoldOut:
    """What of one data set is kept for evaluation; both rules apply where both are given."""

    # Patterns with the wildcards of `fnmatch`. A sequence is held out if one matches its name or one part of the name
    # between slashes: `Scene20` holds out `Scene20/clone/Camera_0`.
    names: tuple[str, ...] = ()
    split: str | None = None  # a split of the same data set, all of whose sequences are held out

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        if not self.names and self.split is None:
            raise InputError("a hold-out needs names or a split; leave the data set out of hold_out otherwise")

    def matches(self, sequence: str) -> bool:
        """Whether `names` hold `sequence` out."""
        parts = (sequence, *sequence.split("/"))
        return any(fnmatchcase(part, pattern) for pattern in self.names for part in parts)


# What published evaluations use: ScanNet's test list, the test sequences of Co3Dv2's fewview_dev lists (the reader's
# split `test`), and the last scene of Virtual KITTI.
PUBLISHED = {
    "scannet": HoldOut(names=tuple(f"scene{number:04d}_00" for number in range(707, 807))),
    "co3dv2": HoldOut(split="test"),
    "virtual_kitti": HoldOut(names=("Scene20",)),
}


def check_held_out(
    name: str, sequences: Sequence[str], rule: HoldOut, split_sequences: Callable[[str], Sequence[str]]
) -> None:
    """Raises InputError naming the training `sequences` of data set `name` that `rule` holds out.

    `split_sequences` gives the sequences of a split of the same data set.
    """
    of_split = set() if rule.split is None else set(split_sequences(rule.split))
    shared = [sequence for sequence in sequences if sequence in of_split or rule.matches(sequence)]
    if shared:
        raise InputError(
            f"{name}: {len(shared)} of {len(sequences)} training sequences are held out for evaluation "
            f"({shown(shared)}): train on another split, or change data.hold_out.{name}"
        )


def check_disjoint(name: str, trained: Dataset, evaluated: Dataset) -> None:
    """Raises InputError naming the sequences that two views of data set `name` share, but for other frames of them."""
    kept = set(evaluated.sequences)
    shared = [sequence for sequence in trained.sequences if sequence in kept]
    # Sequences are listed to be counted only where a range says that it matters.
    if isinstance(trained, FrameRange) or isinstance(evaluated, FrameRange):
        shared = [sequence for sequence in shared if shared_frames(trained, evaluated, sequence)]
    if shared:
        raise InputError(
            f"{name}: {len(shared)} sequences are trained on and validated on ({shown(shared)}): "
            "choose other splits, or other frames, for data.sources and validation.sources"
        )


def shown(names: Sequence[str]) -> str:
    """The first few of `names`, and how many more there are."""
    rest = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {rest} more" if rest > 0 else "")
