"""What a model's weights were trained for, where they come from, and under which licence."""

import dataclasses
from typing import Literal

from logvggt_jax.config import check_longer_edge


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

    def __post_init__(self) -> None:
        if self.longer_edge is not None:
            check_longer_edge(self.longer_edge, "Provenance.longer_edge")
