"""Writes a data set's frames into shards, once; a run that is stopped goes on where it was."""

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from logvggt_jax.data.dataset import Reader
from logvggt_jax.data.errors import NOT_THE_COPY
from logvggt_jax.data.feeding.broken_clips import describe
from logvggt_jax.data.feeding.sampling import CovisibleDataset
from logvggt_jax.data.packed.index import (
    INDEX,
    PLAN,
    PackedIndex,
    PackedSequence,
    PackedShard,
    file_digest,
    is_packed,
    json_digest,
    notes_file,
    read_json_object,
    shard_file,
    write_index,
)
from logvggt_jax.data.packed.records import broken_record, frame_record
from logvggt_jax.data.registry import READERS, open_dataset
from logvggt_jax.data.worker_processes import worker_pool
from logvggt_jax.errors import DiskError, InputError, MissingPackage, OutputExists, disk_errors, install_line, one_line
from logvggt_jax.files import FolderLock, atomic_file, check_writable, holds_nothing, to_disk, user_path, write_text

FRAMES_PER_SHARD = 2000
# One record in a group: a frame is read without its neighbours. Stronger compression takes twice the time for 3 %.
_WRITER = "group_size:1,zstd:1"
_SHOWN = 10


@dataclass(frozen=True)
class PackReport:
    """What `pack` did."""

    output: Path
    sequences: int
    frames: int
    bytes: int
    written: int  # shards that were written now
    kept: int  # shards of an earlier run whose digests were as they should be
    broken: tuple[str, ...]  # of frames and sequences that cannot be read: why

    def text(self) -> str:
        """For people."""
        shards = f"{self.written} shards written" + (f", {self.kept} there and whole" if self.kept else "")
        lines = [
            f"{self.output}: {self.sequences} sequences, {self.frames} frames, {self.bytes / 1e9:.2f} GB; {shards}",
            *(f"  cannot be read, and is kept as such: {message}" for message in self.broken[:_SHOWN]),
        ]
        if len(self.broken) > _SHOWN:
            lines.append(f"  and {len(self.broken) - _SHOWN} more")
        return "\n".join(lines)


def pack(
    name: str,
    root: str | Path,
    output: str | Path,
    *,
    split: str = "all",
    frames_per_shard: int = FRAMES_PER_SHARD,
    workers: int = 1,
    progress: bool = False,
    **options: Any,
) -> PackReport:
    """Packs data set `name` in `root` into the folder `output`, which `open_dataset` then takes for the data set.

    Sequences lie whole, in order, a shard being full with `frames_per_shard` frames. Shards appear when they are
    complete, with their digests; the same command goes on after an interruption, and on a finished folder writes anew
    what is damaged, and what has changed in the data set since (see `Reader.content_digest`) or can be read by now.
    What cannot be read is kept as such: reading it back fails with the same message. A sequence that could not be
    listed at first is packed behind all others once it can. `workers` processes read at once.

    Raises OutputExists where `output` holds something else, InputError where it was begun with other data or settings
    or another run is at work on it, DiskError where it cannot be written, MissingPackage where the set's files need a
    package that is not installed; and as `open_dataset`.
    """
    if frames_per_shard < 1 or workers < 1:
        raise InputError(f"frames per shard and workers must be at least 1, got {frames_per_shard} and {workers}")
    if is_packed(root):
        raise InputError(f"{root} is packed already")
    if name in READERS and not READERS[name].needs_root:
        raise InputError(f"{name} are made when they are read: there is no copy to pack")
    output = user_path(output).absolute()
    check_writable(output)
    reader = open_dataset(name, root, split, **options)
    with disk_errors(output):
        if output.exists() and not holds_nothing(output) and not (output / PLAN).exists():
            raise OutputExists(f"{output} is not empty, and nothing was packed there: choose another output")
    lock = FolderLock(output, "choose another output")
    try:
        return _pack(
            reader, output, _splits(reader, root, split, options), split, options, frames_per_shard, workers, progress
        )
    finally:
        lock.release()


def _pack(
    reader: Reader,
    output: Path,
    splits: dict[str, list[str]],
    split: str,
    options: Mapping[str, Any],
    frames_per_shard: int,
    workers: int,
    progress: bool,
) -> PackReport:
    console = Console(stderr=True, quiet=not progress)
    plan = json_digest([dict(reader.identity), dict(options), split, frames_per_shard, list(reader.sequences)])
    path = output / PLAN
    begun = read_json_object(path) if path.exists() else {"digest": plan, "last": None}
    if "last" not in begun:
        raise InputError(
            f"{output} was packed in an older format, on which no run goes on: choose another output, or delete it"
        )
    if begun.get("digest") != plan:
        raise InputError(
            f"{output} was begun with other data or settings (split, options, frames per shard; or the data set has "
            "other sequences by now): choose another output, or delete this one"
        )
    with console.status("Listing sequences"):
        sequences, contents = _placed(reader, frames_per_shard, begun["last"])
    last = begun["last"]
    if last is None:
        last = [each.name for each in sequences if each.error is not None]
    write_text(path, json.dumps({"digest": plan, "name": reader.name, "split": split, "last": last}) + "\n")
    for scratch in output.glob(".shard-*"):  # of runs that were killed
        scratch.unlink(missing_ok=True)
    count = max((each.shard for each in sequences), default=-1) + 1
    shards: dict[int, tuple[PackedShard, list[str]]] = {}
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("Shards", total=count)
        for number in range(count):
            names = [each.name for each in _in_shard(sequences, number) if each.error is None]
            found = _whole(reader, output, number, plan, {name: contents[name] for name in names})
            if found is not None:
                shards[number] = found
                bar.advance(task)
        kept = len(shards)
        # An index beside shards that are not whole would be believed.
        if kept < count:
            (output / INDEX).unlink(missing_ok=True)
        left = [number for number in range(count) if number not in shards]
        for number, made in _written(reader, output, sequences, contents, left, plan, workers):
            shards[number] = made
            bar.advance(task)
    index = PackedIndex(
        name=reader.name,
        identity=dict(reader.identity),
        options=dict(options),
        split=split,
        splits=splits,
        metric=reader.metric,
        walks=isinstance(reader, CovisibleDataset),
        sequences=tuple(sequences),
        shards=tuple(shards[number][0] for number in range(count)),
    )
    write_index(output, index)
    for number in itertools.takewhile(lambda number: shard_file(output, number).exists(), itertools.count(count)):
        for surplus in (shard_file(output, number), notes_file(output, number)):
            surplus.unlink(missing_ok=True)
    broken = [f"{each.name}: {each.error}" for each in sequences if each.error is not None]
    broken += [message for number in range(count) for message in shards[number][1]]
    size = sum(shard.bytes for shard in index.shards)
    frames = sum(each.frames for each in sequences)
    return PackReport(output, len(sequences), frames, size, count - kept, kept, tuple(broken))


def _splits(reader: Reader, root: str | Path, split: str, options: Mapping[str, Any]) -> dict[str, list[str]]:
    """Names of sequences by split, for those whose lists are there."""
    found = {split: list(reader.sequences)}
    for other in READERS[reader.name].splits:
        if other not in found:
            try:
                found[other] = list(open_dataset(reader.name, root, other, **options).sequences)
            except InputError:  # without list files, or without any of the split's sequences
                continue
    return found


def _placed(
    reader: Reader, frames_per_shard: int, last: Sequence[str] | None
) -> tuple[list[PackedSequence], dict[str, str]]:
    """Every sequence with its place, and digests of the content of those that can be listed.

    Behind the others lie the `last`: those that could not be listed at first, so that the others keep their shards
    once they can; for None that is not known yet.
    """
    placed: dict[str, PackedSequence] = {}
    contents: dict[str, str] = {}
    shard = records = 0
    for name in sorted(reader.sequences, key=(last or ()).__contains__):
        try:
            frames, size, error = reader.num_frames(name), _size(reader, name), None
            if isinstance(reader, CovisibleDataset):
                reader.covisibility(name)
            contents[name] = reader.content_digest(name)
        except NOT_THE_COPY:  # shards of such frames would be worth nothing
            raise
        # Whatever a decoder raises: one damaged sequence is not to keep the others from being packed.
        except Exception as reason:
            frames, size, error = 0, None, describe(reason)
        if records and records + frames > frames_per_shard:
            shard, records = shard + 1, 0
        placed[name] = PackedSequence(name, shard, records, frames, size, error)
        records += frames
    return [placed[name] for name in reader.sequences], contents


def _in_shard(sequences: Iterable[PackedSequence], number: int) -> list[PackedSequence]:
    """Those that lie in a shard, in their order there."""
    return sorted((each for each in sequences if each.shard == number), key=lambda each: each.first)


def _size(reader: Reader, name: str) -> tuple[int, int] | None:
    try:
        return reader.image_size(name)
    except NOT_THE_COPY:
        raise
    except Exception:  # as above; its frames are packed as broken ones
        return None


def _whole(
    reader: Reader, output: Path, number: int, plan: str, contents: Mapping[str, str]
) -> tuple[PackedShard, list[str]] | None:
    """A shard of an earlier run, and what in it cannot be read; None unless it is what that run wrote, of sequences
    with these `contents`, and what could not be read then cannot now."""
    try:
        notes = read_json_object(notes_file(output, number))
        shard, path = PackedShard(**notes["shard"]), shard_file(output, number)
        content = {name: value for name, value in notes.items() if name != "digest"}
        packed = {name: each["content"] for name, each in notes["sequences"].items()}
        same = list(packed.items()) == list(contents.items())  # in their order, too
        if notes["plan"] != plan or not same or notes["digest"] != json_digest(content):
            return None
        broken = [(str(name), int(index), str(message)) for name, index, message in notes["broken"]]
        if file_digest(path) != shard.sha256:
            return None
    except (InputError, LookupError, TypeError, ValueError):
        return None
    # A file that was made readable, or replaced by one of as many bytes, leaves the contents as they were.
    for name, index, message in broken:
        if _record(reader, name, index)[1] != message:
            return None
    return shard, [message for _, _, message in broken]


def _written(
    reader: Reader,
    output: Path,
    sequences: list[PackedSequence],
    contents: Mapping[str, str],
    numbers: list[int],
    plan: str,
    workers: int,
) -> Iterator[tuple[int, tuple[PackedShard, list[str]]]]:
    """Writes shards; their numbers and what `_whole` gives of them, as they are done."""
    parts = {number: _in_shard(sequences, number) for number in numbers}
    if workers == 1 or len(numbers) < 2:
        for number in numbers:
            yield number, _write(reader, output, number, parts[number], contents, plan)
        return
    with worker_pool(workers) as pool:
        futures = {
            pool.submit(_write, reader, output, number, parts[number], contents, plan): number for number in numbers
        }
        for future in as_completed(futures):
            yield futures[future], future.result()


def _write(
    reader: Reader,
    output: Path,
    number: int,
    sequences: list[PackedSequence],
    contents: Mapping[str, str],
    plan: str,
) -> tuple[PackedShard, list[str]]:
    path = shard_file(output, number)
    notes: dict[str, Any] = {}
    broken: list[tuple[str, int, str]] = []
    with atomic_file(path) as temporary:
        with _writing(path):
            writer = _open_writer(temporary)
        for sequence in sequences:
            if sequence.error is not None:
                continue
            notes[sequence.name] = _notes(reader, sequence, contents[sequence.name])
            for index in range(sequence.frames):
                record, message = _record(reader, sequence.name, index)
                if message is not None:
                    broken.append((sequence.name, index, message))
                with _writing(path):
                    writer.write(record)
        with _writing(path):
            writer.close()
        to_disk([temporary])
    shard = PackedShard(sum(each.frames for each in sequences), path.stat().st_size, file_digest(path))
    content = {"plan": plan, "shard": asdict(shard), "broken": broken, "sequences": notes}
    write_text(notes_file(output, number), json.dumps({**content, "digest": json_digest(content)}) + "\n")
    return shard, [message for _, _, message in broken]


def _record(reader: Reader, sequence: str, index: int) -> tuple[bytes, str | None]:
    """The record of a frame, and why it cannot be read, if it cannot."""
    try:
        return frame_record(reader.read(sequence, [index])), None
    except NOT_THE_COPY:
        raise
    except Exception as error:  # whatever a decoder raises
        message = describe(error)
        return broken_record(message), message


def _notes(reader: Reader, sequence: PackedSequence, content: str) -> dict[str, Any]:
    """What a reader knows of a sequence besides its frames, as JSON values."""
    notes: dict[str, Any] = {"frame_names": list(reader.frame_names(sequence.name)), "content": content}
    sfm = reader.sfm_extrinsics(sequence.name, range(sequence.frames))
    if sfm is not None:
        notes["sfm_extrinsics"] = sfm.tolist()
    if isinstance(reader, CovisibleDataset):
        graph = reader.covisibility(sequence.name)
        notes["covisibility"] = [[frame, [[i, score] for i, score in near]] for frame, near in graph.items()]
    return notes


def _open_writer(path: Path) -> Any:
    try:
        from array_record.python.array_record_module import ArrayRecordWriter
    except ImportError as error:
        raise MissingPackage(f"shards need array_record: {install_line('data')}") from error
    return ArrayRecordWriter(str(path), _WRITER)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turns the library's error of a file that cannot be written, a full disk above all, into one line."""
    try:
        yield
    except RuntimeError as error:
        raise DiskError(f"{path}: cannot be written: {one_line(error):.200}") from error
