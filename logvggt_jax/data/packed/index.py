"""What a folder of shards says of itself.

packed.json                 the data set, its splits, every sequence with its place, every shard with its digest;
                            written last: a folder without it is not complete
plan.json                   which sequences go into which shard, for a run of `pack` that goes on
shard-00000.array_record    one record a frame (see `records`), the frames of a sequence in a row
shard-00000.json            of the shard's sequences: names of frames, and what else their reader knows; which frames
                            could not be read, and why
"""

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from logvggt_jax.data.errors import MissingFiles
from logvggt_jax.errors import InputError, disk_errors
from logvggt_jax.files import read_json, write_text

INDEX, PLAN = "packed.json", "plan.json"
FORMAT = "logvggt-jax packed data set"
VERSION = 1
MEND = "pack the data set again with the same command, which writes anew what is damaged"


@dataclass(frozen=True)
class PackedSequence:
    """One sequence and where it lies; `error` says why it could not be listed, it then has no frames."""

    name: str
    shard: int
    first: int  # its first record in the shard
    frames: int
    size: tuple[int, int] | None  # (H, W); None where no picture could be read
    error: str | None = None


@dataclass(frozen=True)
class PackedShard:
    """One file of frames."""

    records: int
    bytes: int
    sha256: str


@dataclass(frozen=True)
class PackedIndex:
    """All that `packed.json` says."""

    name: str
    identity: dict[str, Any]  # of the reader
    options: dict[str, Any]  # of the reader
    split: str
    splits: dict[str, list[str]]  # names of sequences by split, for those that the copy has
    metric: bool
    walks: bool  # whether frames have no order in time, but covisibility
    sequences: tuple[PackedSequence, ...]
    shards: tuple[PackedShard, ...]


def is_packed(root: str | Path) -> bool:
    """Whether a folder holds a packed data set."""
    try:
        return (Path(root) / INDEX).is_file()
    except OSError:
        return False


def shard_file(folder: Path, shard: int) -> Path:
    """The file of a shard's frames."""
    return folder / f"shard-{shard:05d}.array_record"


def notes_file(folder: Path, shard: int) -> Path:
    """The file of what is known of a shard's sequences besides their frames."""
    return folder / f"shard-{shard:05d}.json"


def write_index(folder: Path, index: PackedIndex) -> None:
    """Writes `packed.json`, with a digest of what it says."""
    content = {"format": FORMAT, "version": VERSION, **asdict(index)}
    write_text(folder / INDEX, json.dumps({**content, "digest": json_digest(content)}) + "\n")


def read_index(folder: Path) -> PackedIndex:
    """What `packed.json` says; InputError where it is damaged or another version's."""
    path = folder / INDEX
    content = read_json_object(path)
    digest = content.pop("digest", None)
    if content.get("format") != FORMAT or content.get("version") != VERSION:
        raise InputError(f"{path}: not a packed data set of version {VERSION}; {MEND}")
    if digest != json_digest(content):
        raise InputError(f"{path}: differs from its digest; {MEND}")
    sequences = tuple(
        PackedSequence(**{**each, "size": each["size"] and tuple(each["size"])}) for each in content["sequences"]
    )
    shards = tuple(PackedShard(**each) for each in content["shards"])
    others = {field.name: content[field.name] for field in fields(PackedIndex)}
    return PackedIndex(**{**others, "sequences": sequences, "shards": shards})


def read_json_object(path: Path) -> dict[str, Any]:
    """A file's JSON object; MissingFiles or InputError naming it."""
    if not path.is_file():
        raise MissingFiles(f"{path}: no such file; {MEND}")
    content = read_json(path, MEND)
    if not isinstance(content, dict):
        raise InputError(f"{path}: not a JSON object; {MEND}")
    return content


def json_digest(content: Any) -> str:
    """Digest of JSON values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Digest of a file."""
    with disk_errors(path), path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
