"""What a model's weights were trained for, where they come from, and under which licence."""

from __future__ import annotations

import dataclasses
from typing import Any

from logvggt_jax.errors import InputError

TRAINED_FOR = ("windows", "vggt")


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Kept in a model folder beside the sizes; None where it is not known.

    Attributes:
      trained_for: `windows`, LoG-VGGT's windows with memory between them; or `vggt`, all frames at once, as public
        VGGT weights are.
      longer_edge: pixels of the longer edge of the largest images that they were trained on, a multiple of 14.
      licence: of the weights, as their source names it.
      source: file, hub repository or training run, in a few words.
    """

    trained_for: str | None = None
    longer_edge: int | None = None
    licence: str | None = None
    source: str | None = None

    def __post_init__(self) -> None:
        if self.trained_for not in (None, *TRAINED_FOR):
            raise InputError(f"trained_for must be one of {', '.join(TRAINED_FOR)}, got {self.trained_for!r}")
        edge = self.longer_edge
        if edge is not None and (type(edge) is not int or edge < 14 or edge % 14):
            raise InputError(f"longer_edge must be a positive multiple of 14 pixels, got {edge!r}")
        for name in ("licence", "source"):
            if not isinstance(getattr(self, name), str | None):
                raise InputError(f"{name} must be a text, got {getattr(self, name)!r}")

    def to_dict(self) -> dict[str, Any]:
        """JSON types, the form that model folders store."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Provenance:
        """Inverse of `to_dict`; InputError for anything else."""
        known = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(values, dict) or not set(values) <= set(known):
            raise InputError(f"the record of the weights must have the fields {', '.join(known)}, got {values!r}")
        return cls(**values)
