"""What a model's weights were trained for, where they come from, and under which licence."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from logvggt_jax.config import check_longer_edge, require_counts, require_within


@dataclasses.dataclass(frozen=True)
class TrainingRecord:
    """The training run that made the weights; None where it is not known.

    A run writes what it knows of itself into its model folder, `scripts/ship_model.py` adds the rest.
    """

    command: str | None = None
    commit: str | None = None  # of this package's code
    configuration: Mapping[str, Any] | None = None  # all of the run's settings, as JSON values
    data: str | None = None  # data sets, in a few words
    steps: int | None = None
    device: str | None = None
    minutes: float | None = None  # of training, compilation and rendering included

    def __post_init__(self) -> None:
        require_counts(self, "steps", least=0)
        require_within(self, "(0, inf)", "minutes")


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Kept in a model folder beside the sizes; None where it is not known."""

    # `windows`, LoG-VGGT's windows with memory between them; `vggt`, all frames at once, as public VGGT weights are; or
    # `causal`, frames that see those before them, as StreamVGGT's are.
    trained_for: Literal["windows", "vggt", "causal"] | None = None
    # Pixels of the longer edge of the largest images that they were trained on, a multiple of 14.
    longer_edge: int | None = None
    licence: str | None = None  # of the weights, as their source names it
    source: str | None = None  # file, hub repository or training run, in a few words
    training: TrainingRecord | None = None

    def __post_init__(self) -> None:
        if self.longer_edge is not None:
            check_longer_edge(self.longer_edge, "Provenance.longer_edge")

    def to_dict(self) -> dict[str, Any]:
        """What is known, as JSON values; `from_mapping` reads it back."""
        training = None if self.training is None else _known(dataclasses.asdict(self.training))
        return _known({**dataclasses.asdict(self), "training": training})


def _known(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}
