"""What can be wrong with a copy of a data set, as exceptions that a check counts by kind.

They are ValueErrors or FileNotFoundErrors, as callers expect of bad input; their message names the file and the mend.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar


class MissingFiles(FileNotFoundError):
    """Files that a sequence lacks; made by `missing_files`."""

    kind: ClassVar[str] = "missing file"
    reasons: Mapping[Path, str]  # why each of them is needed, and the mend


def missing_files(reasons: Mapping[Path, str]) -> MissingFiles:
    """The error for these files, at least one, each with why it is needed and the mend: names the first of them."""
    path, reason = next(iter(reasons.items()))
    others = f" (nor {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    # An attribute, since OSError gives a second argument a meaning of its own.
    error = MissingFiles(f"{path}: no such file{others}, {reason}")
    error.reasons = dict(reasons)
    return error


class BrokenPicture(ValueError):
    """A picture or depth file that is truncated, damaged, or of another type than the set's."""

    kind: ClassVar[str] = "broken picture"


class UnequalSizes(ValueError):
    """Pictures and depth whose sizes do not belong together."""

    kind: ClassVar[str] = "unequal sizes"


class UnequalCounts(ValueError):
    """Pictures, depth or cameras that are not equal in number."""

    kind: ClassVar[str] = "unequal counts"


class AbsurdIntrinsics(ValueError):
    """Intrinsics that cannot belong to their picture."""

    kind: ClassVar[str] = "absurd intrinsics"


class BadPose(ValueError):
    """A stored pose that is no rigid transform."""

    kind: ClassVar[str] = "pose that is no rotation"


class EmptySequence(ValueError):
    """A sequence without any frame that counts."""

    kind: ClassVar[str] = "empty sequence"


class EmptySplit(FileNotFoundError):
    """A split whose lists are there and name none of the sequences that this copy has."""

    kind: ClassVar[str] = "empty split"
