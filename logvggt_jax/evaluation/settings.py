"""What a file of `configs/eval` says: a run over clips of one data set, or over the paper's benchmarks."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.costs.throughput import TimingConfig
from logvggt_jax.evaluation.methods.references import ReferenceConfig
from logvggt_jax.evaluation.protocols import ProtocolSettings
from logvggt_jax.evaluation.protocols.clips import ClipSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What both kinds of run say.

    Attributes:
      title: of the report.
      baselines: whether answers that need no learning are evaluated beside the model.
      methods: rows of the model, names of `logvggt_jax.streaming.predictor.METHODS`; the first one is drawn.
      references: limits of the methods `offline` and `chunks`.
      variants: names of `logvggt_jax.evaluation.methods.variants.VARIANTS` that are evaluated beside the methods.
    """

    title: str
    baselines: bool
    methods: tuple[str, ...] = ("windows", "offline", "chunks")
    references: ReferenceConfig = ReferenceConfig()
    variants: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClipRun(Run):
    """Clips of one data set, at one small size: configs/eval/rooms.py, seven_scenes.py, ablations.py.

    Attributes:
      dataset: one of `logvggt_jax.data.DATASETS`.
      split: `train`, `val`, `test` or `all`.
      evaluation: clips and metrics.
      rooms: options of procedural rooms, for `dataset` = `rooms` alone.
    """

    dataset: str
    split: str
    evaluation: ClipSettings
    rooms: Mapping[str, Any] | None = None

    @property
    def max_sequences(self) -> int | None:
        """As in `evaluation`."""
        return self.evaluation.max_sequences

    @property
    def figures(self) -> int:
        """As in `evaluation`."""
        return self.evaluation.figures


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperRun(Run):
    """The paper's benchmarks on the data sets that are there: configs/eval/paper.py.

    Attributes:
      benchmarks: patterns of protocol names, see `logvggt_jax.evaluation.protocols.paper_protocols`.
      protocol: what all benchmarks share.
      max_sequences: only that many first sequences of each benchmark; None takes all. The tables say so.
      figures: clips of each benchmark that are drawn, for the first method.
      timings: sequences that are timed for the paper's tables of cost; None leaves them out.
    """

    benchmarks: tuple[str, ...]
    protocol: ProtocolSettings
    max_sequences: int | None = None
    figures: int = 1
    timings: TimingConfig | None = None

    def __post_init__(self) -> None:
        if not self.benchmarks:
            raise InputError("benchmarks must name at least one, for example ('*',) or ('seven_scenes-*',)")
        if self.max_sequences is not None and self.max_sequences < 1:
            raise InputError(f"max_sequences must be at least 1, got {self.max_sequences}")


def read_run(values: Mapping[str, Any]) -> ClipRun | PaperRun:
    """The run that a configuration file's mapping describes: the paper's where it names `benchmarks`.

    Raises:
      InputError: an unknown, missing or impossible field; named.
    """
    return _from_mapping(PaperRun if "benchmarks" in values else ClipRun, values, "config")


def _from_mapping(cls: Any, values: Any, path: str) -> Any:
    """An instance of a dataclass from a mapping with its fields."""
    hints = typing.get_type_hints(cls)
    arguments = dict(values)
    for name in values:
        if name not in hints:
            raise InputError(f"unknown field {path}.{name}; known are {', '.join(hints)}")
    for field in dataclasses.fields(cls):
        if field.name not in values:
            if field.default is field.default_factory is dataclasses.MISSING:
                raise InputError(f"field {path}.{field.name} is missing")
            continue
        value, hint = values[field.name], hints[field.name]
        alternatives = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        for kind in alternatives:
            if dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
                arguments[field.name] = _from_mapping(kind, value, f"{path}.{field.name}")
            elif typing.get_origin(kind) is tuple and isinstance(value, Sequence):
                arguments[field.name] = tuple(value)
    return cls(**arguments)
