"""What can be wrong with a copy of a data set, as exceptions that a check counts by kind.

All are `InputError`; their message names the file and the mend.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

from logvggt_jax.errors import InputError

# What a reader raises though the copy is sound: for want of a library, or of memory.
NOT_THE_COPY = (ImportError, MemoryError)


class CopyError(InputError):
    """Something in a copy that is to be mended; `kind` is what a check counts it as."""

    kind: ClassVar[str]

    def __init_subclass__(cls, *, kind: str) -> None:
        cls.kind = kind


class MissingFiles(CopyError, FileNotFoundError, kind="missing file"):
    """Files or folders that are not there."""

    reasons: Mapping[Path, str] = MappingProxyType({})  # of a sequence's files: why each is needed, and the mend


def missing_files(reasons: Mapping[Path, str]) -> MissingFiles:
    """The error for these files, at least one, each with why it is needed and the mend: names the first of them."""
    path, reason = next(iter(reasons.items()))
    others = f" (nor {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    # An attribute, since OSError gives a second argument a meaning of its own.
    error = MissingFiles(f"{path}: no such file{others}, {reason}")
    error.reasons = dict(reasons)
    return error


def missing_file(path: str | Path, reason: str = "; fetch it again or remove the frame's other files") -> MissingFiles:
    """The error for a file that was listed or is needed and is not there; `reason` ends its message."""
    what = "no regular file, but a folder, pipe or device" if Path(path).exists() else "no such file"
    return MissingFiles(f"{path}: {what}{reason}")


class BrokenPicture(CopyError, kind="broken picture"):
    """A picture or depth file that is truncated, damaged, or of another type than the set's."""


class UnequalSizes(CopyError, kind="unequal sizes"):
    """Pictures and depth whose sizes do not belong together."""


class UnequalCounts(CopyError, kind="unequal counts"):
    """Pictures, depth or cameras that are not equal in number."""


class AbsurdIntrinsics(CopyError, kind="absurd intrinsics"):
    """Intrinsics that cannot belong to their picture."""


class BadPose(CopyError, kind="pose that is no rotation"):
    """A stored pose that is no rigid transform."""


class EmptySequence(CopyError, kind="empty sequence"):
    """A sequence without any frame that counts."""


class EmptySplit(CopyError, FileNotFoundError, kind="empty split"):
    """A split whose lists are there and name none of the sequences that this copy has."""
