"""What a check of a data set's copy found, as values, JSON and text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

# What a terminal shows; JSON has everything.
_ROWS, _EXAMPLES = 40, 3


@dataclass(frozen=True)
class Problem:
    """Something to mend.

    Attributes:
      kind: as counted, for example `missing file`.
      sequence: where it was found.
      message: one line that begins with the file and ends with the mend.
    """

    kind: str
    sequence: str
    message: str


@dataclass(frozen=True)
class DepthRange:
    """Valid depth of the decoded frames, metres where the set is metric: extremes and the median of frames' medians."""

    minimum: float
    median: float
    maximum: float
    valid_share: float  # of all pixels, 0 to 1


@dataclass(frozen=True)
class SequenceReport:
    """One sequence.

    Attributes:
      name: as the data set has it.
      num_frames: frames that count; 0 where they could not be listed.
      dropped: frames that do not count, by reason (`no pose`).
      has_poses: whether frames have finite poses.
      decoded: frames whose files were opened without an error.
      without_depth: decoded frames in which no pixel has depth.
      image_size: (H, W) of the pictures handed out; None where none was decoded.
      depth: None where no pixel of the decoded frames has depth.
      consistency: median, over pairs of frames, of the median relative difference between the depth of one carried
        into the other and the depth there (see `consistency`); None where no two frames saw the same.
      compared_share: median share of pixels that were compared in these pairs.
      examples: up to two decoded frames, for a picture.
      problems: found here.
    """

    name: str
    num_frames: int = 0
    dropped: Mapping[str, int] | None = None
    has_poses: bool = False
    decoded: int = 0
    without_depth: int = 0
    image_size: tuple[int, int] | None = None
    depth: DepthRange | None = None
    consistency: float | None = None
    compared_share: float | None = None
    examples: Sequence[int] = ()
    problems: Sequence[Problem] = ()


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

    def print(self, console: Console) -> None:
        """Totals, a table of the sequences and the problems; long lists are cut, and say so."""
        for line in self._totals():
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        faulty = [sequence for sequence in self.sequences if sequence.problems]
        shown = self.sequences if len(self.sequences) <= _ROWS else faulty[:_ROWS]
        if shown:
            console.print(self._table(shown))
        if len(shown) < len(self.sequences):
            console.print(f"{len(shown)} of {len(self.sequences)} sequences shown; --json prints all", highlight=False)
        for sequence in faulty:
            for line in _problem_lines(sequence):
                console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _totals(self) -> Iterator[str]:
        frames = sum(sequence.num_frames for sequence in self.sequences)
        decoded = sum(sequence.decoded for sequence in self.sequences)
        looked_at = len(self.sequences)
        part = f"{looked_at:,}" + (f" of {self.sequences_in_split:,}" if looked_at < self.sequences_in_split else "")
        yield f"{self.title} in {self.root}, split {self.split}"
        yield f"{part} sequences, {frames:,} frames; {decoded:,} of them decoded"
        for reason, count in self.dropped_counts().items():
            yield f"{count:,} frames do not count: {reason}"
        figure = self.consistency()
        if figure is None:
            yield "no figure for cross-frame consistency: no poses, no depth, or no two frames that see the same"
        else:
            yield f"cross-frame consistency: depth carried into another frame differs by {figure:.2%} in the median"
        counts = self.problem_counts()
        yield "problems: " + (", ".join(f"{count:,} {kind}" for kind, count in counts.items()) or "none")

    def _table(self, sequences: Sequence[SequenceReport]) -> Table:
        table = Table(box=None, pad_edge=False)
        unit = "m" if self.metric else "units of the set"
        table.add_column("sequence", overflow="fold")
        for title in ("frames", "dropped", "decoded", "H x W", f"depth ({unit})", "valid", "consistency", "problems"):
            table.add_column(title, justify="right")
        for sequence in sequences:
            depth = sequence.depth
            table.add_row(
                sequence.name,
                f"{sequence.num_frames:,}",
                f"{sum((sequence.dropped or {}).values()):,}",
                f"{sequence.decoded:,}",
                "-" if sequence.image_size is None else "{} x {}".format(*sequence.image_size),
                "-" if depth is None else f"{depth.minimum:.3g} / {depth.median:.3g} / {depth.maximum:.3g}",
                "-" if depth is None else f"{depth.valid_share:.0%}",
                "-" if sequence.consistency is None else f"{sequence.consistency:.2%}",
                f"{len(sequence.problems):,}" if sequence.problems else "",
            )
        return table


def _problem_lines(sequence: SequenceReport) -> Iterator[str]:
    by_kind: dict[str, list[Problem]] = {}
    for problem in sequence.problems:
        by_kind.setdefault(problem.kind, []).append(problem)
    for kind, problems in by_kind.items():
        for problem in problems[:_EXAMPLES]:
            yield f"{sequence.name}: {kind}: {problem.message}"
        if len(problems) > _EXAMPLES:
            yield f"{sequence.name}: {kind}: {len(problems) - _EXAMPLES:,} more; --json prints all"
