"""What a file of `configs/eval` says: a run over clips of one data set, or over the paper's benchmarks."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from ml_collections import ConfigDict

from logvggt_jax.config import from_mapping, require_counts
from logvggt_jax.data.option_fields import given_options
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.costs.streams import TimingConfig
from logvggt_jax.evaluation.methods.variants import VARIANTS
from logvggt_jax.evaluation.protocols import ProtocolSettings
from logvggt_jax.evaluation.protocols.clips import ClipSettings
from logvggt_jax.streaming import METHODS


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What both kinds of run say."""

    title: str  # of the report
    baselines: bool  # whether answers that need no learning are evaluated beside the model
    # Rows of the model, names of `logvggt_jax.streaming.METHODS`; the first one is drawn.
    methods: tuple[str, ...] = ("windows", "offline", "chunks")
    # Fields of a method's own settings class, by the method's name, whose hyphen may be an underscore as flags have it;
    # what is left out has that class's defaults.
    settings: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    # Names of `logvggt_jax.evaluation.methods.variants.VARIANTS` that are evaluated beside the methods.
    variants: tuple[str, ...] = ()
    # Sequences that are timed, for the paper's tables of cost or beside the metrics of clips; None leaves them out.
    timings: TimingConfig | None = None

    def __post_init__(self) -> None:
        settings = {name.replace("_", "-"): fields for name, fields in self.settings.items()}
        object.__setattr__(self, "settings", settings)
        for field, known in {"methods": METHODS, "settings": METHODS, "variants": VARIANTS}.items():
            for name in getattr(self, field):
                if name not in known:
                    raise InputError(f"{type(self).__name__}.{field}: unknown {name!r}; known are {', '.join(known)}")
        for name in self.settings:
            self.settings_of(name)
        if not (self.methods or self.variants or self.baselines):
            raise InputError(
                f"{type(self).__name__}.methods names none, nor does variants, and there are no baselines: name one, "
                "or set baselines=True"
            )

    def settings_of(self, method: str) -> Any:
        """Settings of a method, of its own settings class; None where the run says nothing of it."""
        if method not in self.settings:
            return None
        return from_mapping(METHODS[method].settings, self.settings[method], f"settings.{method}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClipRun(Run):
    """Clips of one data set, at one small size: configs/eval/rooms.py, seven_scenes.py, ablations.py."""

    dataset: str  # one of `logvggt_jax.data.DATASETS`
    split: str  # `train`, `val`, `test` or `all`
    evaluation: ClipSettings  # clips and metrics
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # further arguments of the set's reader

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "options", given_options(self.options))

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
    """The paper's benchmarks on the data sets that are there: configs/eval/paper.py."""

    benchmarks: tuple[str, ...]  # patterns of protocol names, see `logvggt_jax.evaluation.protocols.paper_protocols`
    protocol: ProtocolSettings  # what all benchmarks share
    # Only that many first sequences of each benchmark; None takes all. The tables say so.
    max_sequences: int | None = None
    figures: int = 1  # clips of each benchmark that are drawn, for the first method

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.benchmarks:
            raise InputError("PaperRun.benchmarks must name at least one, for example ('*',) or ('seven_scenes-*',)")
        require_counts(self, "max_sequences")
        require_counts(self, "figures", least=0)


def method_fields(chosen: Mapping[str, Mapping[str, Any]]) -> ConfigDict:
    """The settings of all methods as a configuration file holds them, so that each can be given on the command line,
    under the method's name with an underscore for its hyphen.

    Args:
      chosen: of some methods, by name, settings and their values; the others are the defaults.
    """
    fields = {}
    for name, method in METHODS.items():
        fields[name.replace("-", "_")] = {**dataclasses.asdict(method.settings()), **chosen.get(name, {})}
    return ConfigDict(fields, sort_keys=False)


def read_run(values: Mapping[str, Any]) -> ClipRun | PaperRun:
    """The run that a configuration file's mapping describes: the paper's where it names `benchmarks`.

    Raises InputError naming an unknown, missing or impossible field.
    """
    if "benchmarks" in values:
        return from_mapping(PaperRun, values, "config")
    return from_mapping(ClipRun, values, "config")
