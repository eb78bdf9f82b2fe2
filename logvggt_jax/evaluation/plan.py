"""What is evaluated: benchmarks, and the clips of their data."""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any

from logvggt_jax.data.dataset import Reader
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.environment import code_version
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.protocols.protocol import Protocol
from logvggt_jax.evaluation.records import record_key


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """A protocol and the data it finds."""

    protocol: Protocol  # frames, images, metrics
    dataset: Reader | None  # None where the data set is missing
    split: str  # the one that is evaluated
    missing: str = ""  # why `dataset` is None

    @property
    def sequences(self) -> list[str]:
        """Names of the sequences that belong to the benchmark."""
        if self.dataset is None:
            return []
        return [name for name in self.dataset.sequences if self.protocol.takes(name)]


@dataclasses.dataclass(frozen=True)
class Clip:
    """Frames `indices` of `sequence` of a benchmark, which has this `content` (see `Reader.content_digest`)."""

    benchmark: Benchmark
    sequence: str
    indices: tuple[int, ...]
    content: str = ""

    @property
    def address(self) -> dict[str, Any]:
        """Where the clip stands in results: `benchmark`, `sequence` and the number of `frames` wanted."""
        protocol = self.benchmark.protocol
        return {"benchmark": protocol.name, "sequence": self.sequence, "frames": protocol.frames.wanted}

    def key(self, method: Method) -> str:
        """Digest of what decides the clip's numbers, and of the names under which they stand in the file."""
        protocol, dataset = self.benchmark.protocol, self.benchmark.dataset
        assert dataset is not None  # only a data set that is there has clips
        names = [protocol.name, method.name]
        data = [protocol.dataset, dataset.identity, self.sequence, self.indices, self.content]
        claims = [method.depth, method.pose, method.points, method.static]
        return record_key(code_version(), names, data, protocol.measures(), claims, method.identity)


def image_sizes(benchmarks: Sequence[Benchmark]) -> list[tuple[int, int]]:
    """Different (H, W) of the images that a network sees, by the first sequence of each benchmark whose data are there.

    A sequence whose pictures cannot be read tells none; that it cannot is said of its clips.
    """
    found: dict[tuple[int, int], None] = {}
    for benchmark in benchmarks:
        for sequence in benchmark.sequences[:1]:
            assert benchmark.dataset is not None  # it has sequences
            with contextlib.suppress(InputError, OSError):
                found[benchmark.protocol.images.size(benchmark.dataset.image_size(sequence))] = None
    return list(found)


def plan_clips(
    benchmarks: Sequence[Benchmark], max_sequences: int | None = None
) -> tuple[list[Clip], list[dict[str, Any]]]:
    """Clips in order of benchmark, then sequence; and the sequences that give none, with the reason."""
    clips: list[Clip] = []
    skipped: list[dict[str, Any]] = []
    for benchmark in benchmarks:
        for sequence in benchmark.sequences[:max_sequences]:
            assert benchmark.dataset is not None  # it has sequences
            try:
                count = benchmark.dataset.num_frames(sequence)
                chosen = benchmark.protocol.frames(sequence, count)
                content = benchmark.dataset.content_digest(sequence)
            except (InputError, OSError) as error:
                skipped.append({**Clip(benchmark, sequence, ()).address, "reason": str(error)})
                continue
            clips += [Clip(benchmark, sequence, indices, content) for indices in chosen]
    return clips, skipped
