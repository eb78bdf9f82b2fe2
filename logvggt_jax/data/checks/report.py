"""What a check of a data set's copy found, as values, JSON and text."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from logvggt_jax.errors import printable

# What a terminal shows; JSON has everything.
_LINES, _EXAMPLES = 40, 3


@dataclass(frozen=True)
class Problem:
    """Something to mend."""

    kind: str  # as counted, for example `missing file`
    sequence: str  # where it was found
    message: str  # one line that begins with the file and ends with the mend


@dataclass(frozen=True)
class DepthRange:
    """Valid depth of the decoded frames, metres where the set is metric: extremes and the median of frames' medians."""

    minimum: float
    median: float
    maximum: float
    valid_share: float  # of all pixels, 0 to 1


@dataclass(frozen=True)
class SequenceReport:
    """One sequence."""

    name: str  # as the data set has it
    num_frames: int = 0  # frames that count; 0 where they could not be listed
    dropped: Mapping[str, int] | None = None  # frames that do not count, by reason (`no pose`)
    has_poses: bool = False  # whether frames have finite poses
    decoded: int = 0  # frames whose files were opened without an error
    without_depth: int = 0  # decoded frames in which no pixel has depth
    image_size: tuple[int, int] | None = None  # (H, W) of the pictures handed out; None where none was decoded
    depth: DepthRange | None = None  # None where no pixel of the decoded frames has depth
    # Median, over pairs of frames, of the median relative difference between the depth of one carried into the other
    # and the depth there (see `consistency`); None where no two frames saw the same.
    consistency: float | None = None
    compared_share: float | None = None  # median share of pixels that were compared in these pairs
    examples: Sequence[int] = ()  # up to two decoded frames, for a picture
    problems: Sequence[Problem] = ()  # found here


@dataclass(frozen=True)
class CheckReport:
    """A copy of a data set; `sequences_in_split` of them exist, `sequences` were looked at."""

    name: str
    title: str
    root: str
    split: str
    metric: bool
    sequences_in_split: int
    sequences: Sequence[SequenceReport]

    @property
    def problems(self) -> list[Problem]:
        """All problems, sequence by sequence."""
        return [problem for sequence in self.sequences for problem in sequence.problems]

    def problem_counts(self) -> dict[str, int]:
        """Problems by kind, the most frequent first."""
        return dict(Counter(problem.kind for problem in self.problems).most_common())

    def dropped_counts(self) -> dict[str, int]:
        """Frames that do not count, by reason."""
        counts: Counter[str] = Counter()
        for sequence in self.sequences:
            counts.update(sequence.dropped or {})
        return dict(counts)

    def consistency(self) -> float | None:
        """Median of the sequences' figures; None where there is none."""
        figures = [sequence.consistency for sequence in self.sequences if sequence.consistency is not None]
        return float(np.median(figures)) if figures else None

    def as_json(self) -> dict[str, Any]:
        """Everything, as JSON values; lengths in metres where `metric`."""
        return {
            **{key: getattr(self, key) for key in ("name", "title", "root", "split", "metric", "sequences_in_split")},
            "frames": sum(sequence.num_frames for sequence in self.sequences),
            "decoded": sum(sequence.decoded for sequence in self.sequences),
            "dropped": self.dropped_counts(),
            "consistency": self.consistency(),
            "problem_counts": self.problem_counts(),
            "sequences": [asdict(sequence) for sequence in self.sequences],
        }

    def text(self) -> str:
        """Totals, a line for each sequence, and the problems; long lists are cut, and say so."""
        lines = list(self._totals())
        faulty = [sequence for sequence in self.sequences if sequence.problems]
        shown = self.sequences if len(self.sequences) <= _LINES else faulty[:_LINES]
        lines += (self._line(sequence) for sequence in shown)
        if len(shown) < len(self.sequences):
            lines.append(f"({len(shown):,} of {len(self.sequences):,} sequences shown; --json prints all)")
        for sequence in faulty:
            lines += _problem_lines(sequence)
        return "\n".join(map(printable, lines))

    def _totals(self) -> Iterator[str]:
        frames = sum(sequence.num_frames for sequence in self.sequences)
        decoded = sum(sequence.decoded for sequence in self.sequences)
        looked_at = len(self.sequences)
        part = f"{looked_at:,}" + (f" of {self.sequences_in_split:,}" if looked_at < self.sequences_in_split else "")
        yield f"{self.title} in {self.root}, split {self.split}"
        yield f"{part} sequences, {frames:,} frames, {decoded:,} of them decoded; depth is minimum / median / maximum"
        for reason, count in self.dropped_counts().items():
            yield f"{count:,} frames do not count: {reason}"
        figure = self.consistency()
        if figure is None:
            yield "no figure for cross-frame consistency: no poses, no depth, or no two frames that see the same"
        else:
            yield f"cross-frame consistency: depth carried into another frame differs by {figure:.2%} in the median"
        counts = self.problem_counts()
        yield "problems: " + (", ".join(f"{count:,} {kind}" for kind, count in counts.items()) or "none")

    def _line(self, sequence: SequenceReport) -> str:
        parts = [f"{sequence.num_frames:,} frames" if sequence.num_frames else "frames could not be listed"]
        parts += [f"{count:,} dropped ({reason})" for reason, count in (sequence.dropped or {}).items()]
        if sequence.image_size is not None:
            parts.append("{} x {} pixels (H x W)".format(*sequence.image_size))
        if sequence.depth is not None:
            depth, unit = sequence.depth, " m" if self.metric else ""
            parts.append(f"depth {depth.minimum:.3g} / {depth.median:.3g} / {depth.maximum:.3g}{unit}")
            parts.append(f"{depth.valid_share:.0%} valid")
        if sequence.without_depth:
            parts.append(f"{sequence.without_depth:,} without depth")
        if sequence.consistency is not None:
            parts.append(f"consistency {sequence.consistency:.2%}")
        if sequence.problems:
            parts.append(f"problems: {len(sequence.problems):,}")
        return f"  {sequence.name}: {', '.join(parts)}"


def _problem_lines(sequence: SequenceReport) -> Iterator[str]:
    by_kind: dict[str, list[Problem]] = {}
    for problem in sequence.problems:
        by_kind.setdefault(problem.kind, []).append(problem)
    for kind, problems in by_kind.items():
        for problem in problems[:_EXAMPLES]:
            yield f"{sequence.name}: {kind}: {problem.message}"
        if len(problems) > _EXAMPLES:
            yield f"{sequence.name}: {kind}: {len(problems) - _EXAMPLES:,} more; --json prints all"
