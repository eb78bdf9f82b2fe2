"""What a file of `configs/eval` says."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from logvggt_jax.evaluation.costs.throughput import TimingConfig
from logvggt_jax.evaluation.methods.references import ReferenceConfig
from logvggt_jax.evaluation.protocols.protocol import ProtocolSettings

Settings = TypeVar("Settings")


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """Short clips of one data set, with all metrics, at one small size.

    Attributes:
      image_size: (H, W) of the model's input, multiples of 14; frames are resized and cropped to it.
      clip_lengths: frames of a clip.
      stride: frames of the sequence from one frame of a clip to the next.
      clips_per_sequence: clips with evenly spaced starts in each sequence.
      max_sequences: only that many first sequences; None takes all.
      max_points: points compared in each clip, drawn at random, the same for prediction and truth; None takes all.
      icp_threshold: metres, of the ICP before the point metrics; None leaves it out.
      seed: of the drawn points.
      figures: clips of each length that are drawn, for the first method.
    """

    image_size: tuple[int, int]
    clip_lengths: tuple[int, ...]
    stride: int = 1
    clips_per_sequence: int = 1
    max_sequences: int | None = None
    max_points: int | None = 20_000
    icp_threshold: float | None = 0.1
    seed: int = 0
    figures: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "image_size", tuple(self.image_size))
        object.__setattr__(self, "clip_lengths", tuple(self.clip_lengths))
        if len(self.image_size) != 2 or any(side < 14 or side % 14 for side in self.image_size):
            raise ValueError(f"image_size must be (H, W), multiples of 14, got {self.image_size}")
        if not self.clip_lengths or any(length < 2 for length in self.clip_lengths):
            raise ValueError(f"clip_lengths must be at least one number of 2 or more frames, got {self.clip_lengths}")
        for name in ("stride", "clips_per_sequence", "max_sequences", "max_points"):
            _check_count(name, getattr(self, name))
        if self.icp_threshold is not None and not self.icp_threshold > 0:
            raise ValueError(f"icp_threshold must be positive or None, got {self.icp_threshold}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EvaluationConfig:
        """From a configuration file's mapping; ValueError for an unknown or missing field, naming it."""
        return _from_mapping(cls, values, "evaluation.")


@dataclasses.dataclass(frozen=True)
class EvaluationRun:
    """A whole evaluation of short clips: one data set.

    Attributes:
      title: of the report.
      dataset: one of `logvggt_jax.data.DATASETS`.
      split: `train`, `val`, `test` or `all`.
      baselines: whether the baselines are evaluated beside the network.
      evaluation: clips and metrics.
      rooms: options of procedural rooms, for `dataset` = `rooms` alone.
      references: limits of the reference models; None leaves them out.
      variants: names of `logvggt_jax.evaluation.methods.variants.VARIANTS` that are evaluated beside the network.
    """

    title: str
    dataset: str
    split: str
    baselines: bool
    evaluation: EvaluationConfig
    rooms: Mapping[str, Any] | None = None
    references: ReferenceConfig | None = None
    variants: tuple[str, ...] = ()

    @property
    def max_sequences(self) -> int | None:
        """As in `evaluation`."""
        return self.evaluation.max_sequences

    @property
    def figures(self) -> int:
        """As in `evaluation`."""
        return self.evaluation.figures

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EvaluationRun:
        """From a configuration file's mapping; ValueError for an unknown or missing field, naming it."""
        run = _from_mapping(cls, values, "")
        return dataclasses.replace(
            run,
            evaluation=EvaluationConfig.from_dict(values["evaluation"]),
            references=_references(values),
            variants=tuple(run.variants),
        )


@dataclasses.dataclass(frozen=True)
class BenchmarkRun:
    """A whole evaluation by the paper's protocols, on the data sets that are there.

    Attributes:
      title: of the report.
      benchmarks: patterns of protocol names, see `logvggt_jax.evaluation.protocols.paper_protocols`.
      baselines: whether a constant depth and a camera that stands still are evaluated beside the network.
      protocol: what all benchmarks share.
      max_sequences: only that many first sequences of each benchmark; None takes all. The tables say so.
      figures: clips of each benchmark that are drawn, for the first method.
      references: limits of the reference models; None leaves them out.
      variants: names of `logvggt_jax.evaluation.methods.variants.VARIANTS` that are evaluated beside the network.
      timings: sequences that are timed for the paper's tables of cost; None leaves them out.
    """

    title: str
    benchmarks: tuple[str, ...]
    baselines: bool
    protocol: ProtocolSettings
    max_sequences: int | None = None
    figures: int = 1
    references: ReferenceConfig | None = None
    variants: tuple[str, ...] = ()
    timings: TimingConfig | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "benchmarks", tuple(self.benchmarks))
        if not self.benchmarks:
            raise ValueError("benchmarks must name at least one, for example ('*',) or ('seven_scenes-*',)")
        _check_count("max_sequences", self.max_sequences)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> BenchmarkRun:
        """From a configuration file's mapping; ValueError for an unknown or missing field, naming it."""
        run = _from_mapping(cls, values, "")
        timings = values.get("timings")
        return dataclasses.replace(
            run,
            protocol=_from_mapping(ProtocolSettings, values["protocol"], "protocol."),
            references=_references(values),
            variants=tuple(run.variants),
            timings=None if timings is None else _from_mapping(TimingConfig, timings, "timings."),
        )


def read_run(values: Mapping[str, Any]) -> EvaluationRun | BenchmarkRun:
    """The run that a configuration file's mapping describes: the paper's where it names `benchmarks`."""
    return BenchmarkRun.from_dict(values) if "benchmarks" in values else EvaluationRun.from_dict(values)


def _references(values: Mapping[str, Any]) -> ReferenceConfig | None:
    limits = values.get("references")
    return None if limits is None else _from_mapping(ReferenceConfig, limits, "references.")


def _check_count(name: str, value: Any) -> None:
    if value is not None and not isinstance(value, int):
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    if value is not None and value < 1:
        raise ValueError(f"{name} must be at least 1, got {value}")


def _from_mapping(cls: type[Settings], values: Mapping[str, Any], prefix: str) -> Settings:
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    known = [field.name for field in fields]
    for name in values:
        if name not in known:
            raise ValueError(f"unknown field {prefix}{name}; known are {', '.join(known)}")
    missing = dataclasses.MISSING
    for field in fields:
        if field.name not in values and field.default is missing and field.default_factory is missing:
            raise ValueError(f"field {prefix}{field.name} is missing from the configuration")
    return cls(**values)
