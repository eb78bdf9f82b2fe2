"""Everything that a training run can be told, as frozen dataclasses: validated on construction, hashable.

There are no hyperparameters in code: files under `configs/` state them all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from logvggt_jax.config import ModelConfig

LOSSES = ("log_vggt", "vggt")
SCHEDULES = ("cosine", "linear_tail")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """The objective: `name` is `log_vggt` (the paper's) or `vggt` (VGGT's released trainer).

    `translation_weight`, `rotation_weight` and `field_of_view_weight` weigh the parts of the camera loss, `gamma`
    decays earlier rounds of the camera head, `alpha` rewards confidence. `quantile` (vggt only) drops the largest
    depth errors, None keeps all.
    """

    name: str
    camera_weight: float
    depth_weight: float
    translation_weight: float
    rotation_weight: float
    field_of_view_weight: float
    gamma: float
    alpha: float
    quantile: float | None = None

    def __post_init__(self) -> None:
        _require(self.name in LOSSES, f"loss.name must be one of {LOSSES}, got {self.name!r}")
        _require(0 < self.gamma <= 1, f"loss.gamma must lie in (0, 1], got {self.gamma}")
        _require(
            self.quantile is None or 0 < self.quantile <= 1,
            f"loss.quantile must lie in (0, 1] or be None, got {self.quantile}",
        )


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with clipping by module.

    The rate climbs linearly over `warmup_fraction` of the schedule and then follows a `cosine`, or stays and
    falls linearly over the last quarter (`linear_tail`), to `final_learning_rate`. With `restart_each_stage` every
    stage of the curriculum runs the schedule anew. `decay_all` applies weight decay to vectors (biases, norms,
    gains) too.
    """

    learning_rate: float
    final_learning_rate: float
    schedule: str
    warmup_fraction: float
    restart_each_stage: bool
    b1: float
    b2: float
    weight_decay: float
    decay_all: bool
    clip_norm: float

    def __post_init__(self) -> None:
        _require(
            self.schedule in SCHEDULES, f"optimizer.schedule must be one of {SCHEDULES}, got {self.schedule!r}"
        )
        _require(self.learning_rate > 0, f"optimizer.learning_rate must be positive, got {self.learning_rate}")
        _require(
            0 <= self.warmup_fraction < 0.75,
            f"optimizer.warmup_fraction must lie in [0, 0.75), got {self.warmup_fraction}",
        )
        _require(self.clip_norm > 0, f"optimizer.clip_norm must be positive, got {self.clip_norm}")


@dataclasses.dataclass(frozen=True)
class StageConfig:
    """One stage of the curriculum: `steps` batches of `batch_size` clips (over all devices) of `clip_length` frames.

    Strides are drawn from `min_stride` to `max_stride`. Images are `sizes`, (height, width) each: one compiled
    program and one data stream a size, taken in turn.
    """

    name: str
    steps: int
    clip_length: int
    batch_size: int
    min_stride: int
    max_stride: int
    sizes: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "sizes", tuple((int(h), int(w)) for h, w in self.sizes))
        for field in ("steps", "clip_length", "batch_size", "min_stride", "max_stride"):
            value = getattr(self, field)
            _require(
                isinstance(value, int) and value >= 1, f"stage {self.name!r}: {field} must be >= 1, got {value!r}"
            )
        _require(
            self.min_stride <= self.max_stride,
            f"stage {self.name!r}: min_stride={self.min_stride} exceeds max_stride={self.max_stride}",
        )
        _require(bool(self.sizes), f"stage {self.name!r}: sizes is empty, give at least one (height, width)")
