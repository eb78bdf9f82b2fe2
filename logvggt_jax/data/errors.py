"""What can be wrong with a copy of a data set, as exceptions that a check counts by kind.

All are `InputError`; their message names the file and the mend.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

from logvggt_jax.errors import InputError


class MissingFiles(InputError, FileNotFoundError):
    """Files or folders that are not there."""

    kind: ClassVar[str] = "missing file"
    reasons: Mapping[Path, str] = MappingProxyType({})  # of a sequence's files: why each is needed, and the mend


def missing_files(reasons: Mapping[Path, str]) -> MissingFiles:
    """The error for these files, at least one, each with why it is needed and the mend: names the first of them."""
    path, reason = next(iter(reasons.items()))
    others = f" (nor {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    # An attribute, since OSError gives a second argument a meaning of its own.
    error = MissingFiles(f"{path}: no such file{others}, {reason}")
    error.reasons = dict(reasons)
    return error


def missing_file(path: str | Path) -> MissingFiles:
    """The error for a picture or depth file that was listed and is no longer there."""
    return MissingFiles(f"{path}: no such file; fetch it again or remove the frame's other files")


class BrokenPicture(InputError):
    """A picture or depth file that is truncated, damaged, or of another type than the set's."""

    kind: ClassVar[str] = "broken picture"


class UnequalSizes(InputError):
    """Pictures and depth whose sizes do not belong together."""

    kind: ClassVar[str] = "unequal sizes"


class UnequalCounts(InputError):
    """Pictures, depth or cameras that are not equal in number."""

    kind: ClassVar[str] = "unequal counts"


class AbsurdIntrinsics(InputError):
    """Intrinsics that cannot belong to their picture."""

    kind: ClassVar[str] = "absurd intrinsics"


class BadPose(InputError):
    """A stored pose that is no rigid transform."""

    kind: ClassVar[str] = "pose that is no rotation"


class EmptySequence(InputError):
    """A sequence without any frame that counts."""

    kind: ClassVar[str] = "empty sequence"


class EmptySplit(InputError, FileNotFoundError):
    """A split whose lists are there and name none of the sequences that this copy has."""

    kind: ClassVar[str] = "empty split"
