"""What a benchmark is: frames, images, metrics, and the decisions that its paper leaves to the reader."""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

from logvggt_jax.config import check_longer_edge, require_counts, require_within
from logvggt_jax.data.option_fields import given_options
from logvggt_jax.evaluation.protocols.frame_selection import FrameSelection
from logvggt_jax.evaluation.protocols.images import ImageRule


@dataclasses.dataclass(frozen=True)
class DepthMeasure:
    """Depth errors of a clip, pooled over its valid pixels."""

    max_depth: float | None = None  # metres; true depth from here on is not valid. None for no bound.
    clip: float | None = None  # metres; bound put on the aligned prediction. None for none.


@dataclasses.dataclass(frozen=True)
class PointsMeasure:
    """Accuracy, completeness and normal consistency of the cloud of all frames."""

    crop: int | None = None  # pixels; only the middle crop x crop pixels of each frame count. None for all.
    # Points compared, drawn at random, the same for prediction and truth; None for all.
    max_points: int | None = 1_000_000
    icp_threshold: float | None = 0.1  # metres; None leaves the ICP out
    seed: int = 0  # of the drawn points


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A benchmark."""

    name: str  # unique, fit for a file name
    title: str  # for tables
    dataset: str  # one of `logvggt_jax.data.DATASETS`
    splits: tuple[str, ...]  # the first of these that the folder has is evaluated
    frames: FrameSelection  # clips of a sequence
    images: ImageRule  # what the network sees
    depth: DepthMeasure | None = None  # None where depth is not measured
    points: PointsMeasure | None = None  # None where the cloud is not measured
    poses: bool = False  # whether relative poses (RRA, RTA, AUC) are measured
    trajectory: bool = False  # whether ATE is measured
    sequences: str = r".*"  # pattern that the whole name of a sequence must match
    expected: int | None = None  # sequences that the complete benchmark has, None where it depends on the split's list
    # Pairs of poses are pooled over the sequences of a category (the name's first part), and the mean is over
    # categories; otherwise it is over sequences.
    pooled: bool = False
    # Its sequences are dealt round into so many sets; what is printed beside a mean is how far the sets' own differ.
    sets: int = 1
    decisions: tuple[str, ...] = ()  # what the paper leaves open, as decided here; printed with the results

    def __post_init__(self) -> None:
        if self.points is not None and not self.images.keeps_grid:
            raise ValueError(f"{self.name}: points need images on whose pixels the true depth lies")
        if not (self.depth or self.points or self.poses or self.trajectory):
            raise ValueError(f"{self.name}: nothing is measured")

    @property
    def needs_depth(self) -> bool:
        """Whether true depth is read."""
        return self.depth is not None or self.points is not None

    def takes(self, sequence: str) -> bool:
        """Whether a sequence of the data set belongs to the benchmark."""
        # A folder's name can hold a line's end.
        return re.fullmatch(self.sequences, sequence, re.DOTALL) is not None

    def measures(self) -> dict[str, Any]:
        """What decides the numbers of given frames: the images' rule and the metrics, as JSON values."""
        described = self.describe()
        return {name: described[name] for name in ("images", "depth", "points", "poses", "trajectory")}

    def describe(self) -> dict[str, Any]:
        """All settings, as JSON values, for the report."""
        settings = dataclasses.asdict(self)
        for part in ("frames", "images"):
            settings[part] = {"rule": type(getattr(self, part)).__name__, **settings[part]}
        return settings


@dataclasses.dataclass(frozen=True)
class ProtocolSettings:
    """What all benchmarks of the paper share (`protocol` in configs/eval/paper.py)."""

    # Pixels of the network's images, a multiple of 14; 518 is the paper's. The middle crop of reconstruction scales
    # with it.
    longer_edge: int = 518
    max_points: int | None = 1_000_000  # of `PointsMeasure`
    icp_threshold: float | None = 0.1  # of `PointsMeasure`
    seed: int = 0  # of drawn frames and points
    # Further arguments of data sets' readers, by the set's name.
    options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        check_longer_edge(self.longer_edge, "ProtocolSettings.longer_edge", least=28)
        require_counts(self, "max_points")
        require_counts(self, "seed", least=0)
        require_within(self, "(0, inf)", "icp_threshold")
        given = {name: given_options(options) for name, options in self.options.items()}
        object.__setattr__(self, "options", given)

    @property
    def points(self) -> PointsMeasure:
        """The reconstruction benchmarks' measure: the middle 224 x 224 of 518-pixel images."""
        crop = 2 * max(1, round(112 * self.longer_edge / 518))
        return PointsMeasure(crop, self.max_points, self.icp_threshold, self.seed)

    @property
    def points_decisions(self) -> tuple[str, ...]:
        """How points are compared, for the report."""
        points = "all" if self.max_points is None else f"at most {self.max_points:,}"
        icp = "no ICP" if self.icp_threshold is None else f"rigid ICP within {self.icp_threshold} m"
        return (
            "Points are predicted depth unprojected with predicted intrinsics and pose (the paper trains no point "
            "head), pixels with a true depth in the middle crop of each frame, aligned by one similarity over "
            f"corresponding pixels, then {icp}; no confidence threshold. Tables made with the other alignment in use "
            "(median scale and z-shift) cannot be compared with it.",
            f"{points} points of a sequence are compared, drawn with seed {self.seed}, the same pixels of prediction "
            "and truth (published code takes all of 10 to 50 million, or 999,999).",
        )
