"""Everything that a training run can be told, as frozen dataclasses: validated on construction, hashable.

There are no hyperparameters in code: files under `configs/` state them all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from logvggt_jax.config import ModelConfig
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.holdouts import HoldOut

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
        _require(self.schedule in SCHEDULES, f"optimizer.schedule must be one of {SCHEDULES}, got {self.schedule!r}")
        _require(self.learning_rate > 0, f"optimizer.learning_rate must be positive, got {self.learning_rate}")
        _require(
            0 <= self.warmup_fraction < 0.75,
            f"optimizer.warmup_fraction must lie in [0, 0.75), got {self.warmup_fraction}",
        )
        _require(self.clip_norm > 0, f"optimizer.clip_norm must be positive, got {self.clip_norm}")


@dataclasses.dataclass(frozen=True)
class StageConfig:
    """One stage of the curriculum: `steps` batches of `batch_size` clips (over all devices) of `clip_length` frames.

    Strides are drawn from `min_stride` to `max_stride`. Images are `sizes`, (height, width) each, one compiled
    program a size: a clip has the one nearest to its own aspect ratio, a batch clips of one size.
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
            _require(isinstance(value, int) and value >= 1, f"stage {self.name!r}: {field} must be >= 1, got {value!r}")
        _require(
            self.min_stride <= self.max_stride,
            f"stage {self.name!r}: min_stride={self.min_stride} exceeds max_stride={self.max_stride}",
        )
        _require(bool(self.sizes), f"stage {self.name!r}: sizes is empty, give at least one (height, width)")


@dataclasses.dataclass(frozen=True)
class SourceConfig:
    """One data set of a mixture.

    `weight` is its share of the clips relative to the others'. `stride`, smallest and largest, takes the place of
    the stage's. `options` (sorted pairs) are the keyword arguments of procedural rooms.
    """

    name: str
    root: str | None
    split: str
    weight: float = 1.0
    stride: tuple[int, int] | None = None
    options: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "options", tuple(sorted((key, _frozen(value)) for key, value in dict(self.options).items()))
        )
        _require(self.weight > 0, f"data set {self.name!r}: weight must be positive, got {self.weight}")
        if self.stride is not None:
            object.__setattr__(self, "stride", tuple(self.stride))
            _require(
                len(self.stride) == 2 and 1 <= self.stride[0] <= self.stride[1],
                f"data set {self.name!r}: stride must be a pair 1 <= low <= high, got {self.stride}",
            )


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """The training mixture.

    Clips run backwards in time with probability `reverse`. `worker_count` processes read ahead (0: none, this
    process reads), each with `num_threads` threads. Rendered rooms are kept in `cache_dir`, in memory if None.
    `hold_out` (sorted pairs of data set and rule) says what must not be trained on. A data set whose folder does not
    exist is an error, with `allow_missing` a warning: the others then share its part. `augmentation` changes the
    pictures' colours, None leaves them. A clip that cannot be read, or of whose pixels less than `min_valid_depth`
    have depth, is replaced; more than `max_broken` of the clips end the run, with 0 the first.
    """

    sources: tuple[SourceConfig, ...]
    reverse: float
    worker_count: int
    num_threads: int
    cache_dir: str | None
    hold_out: tuple[tuple[str, HoldOut], ...] = ()
    allow_missing: bool = False
    augmentation: ColourAugmentation | None = None
    min_valid_depth: float = 0.0
    max_broken: float = 0.0

    def __post_init__(self) -> None:
        _require(bool(self.sources), "data.sources is empty: name at least one data set")
        for field in ("min_valid_depth", "max_broken"):
            _require(0 <= getattr(self, field) < 1, f"data.{field} must lie in [0, 1), got {getattr(self, field)}")


@dataclasses.dataclass(frozen=True)
class ValidationConfig:
    """Every `every` steps, `num_clips` fixed clips of `clip_length` frames, `stride` apart, of a held-out set."""

    source: SourceConfig
    every: int
    num_clips: int
    clip_length: int
    stride: int
    size: tuple[int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", tuple(self.size))
        for field in ("every", "num_clips", "stride"):
            _require(getattr(self, field) >= 1, f"validation.{field} must be >= 1, got {getattr(self, field)}")
        _require(self.clip_length >= 2, "validation.clip_length must be >= 2: pose errors are of pairs of frames")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole run.

    `initial_weights` is a path or hub repository that `from_pretrained` reads, None starts from random numbers.
    The run stops in good order after `max_minutes`, and with an error after `max_skipped_in_a_row` updates in a
    row that were not finite. `save_every` steps, and at the end, it writes a checkpoint and keeps the latest
    `keep_checkpoints`.
    """

    model: ModelConfig
    loss: LossConfig
    optimizer: OptimizerConfig
    stages: tuple[StageConfig, ...]
    data: DataConfig
    validation: ValidationConfig | None
    seed: int
    initial_weights: str | None
    log_every: int
    save_every: int
    keep_checkpoints: int
    max_skipped_in_a_row: int
    max_minutes: float | None

    def __post_init__(self) -> None:
        _require(bool(self.stages), "stages is empty: a run needs at least one")
        for field in ("log_every", "save_every", "keep_checkpoints", "max_skipped_in_a_row"):
            _require(getattr(self, field) >= 1, f"{field} must be >= 1, got {getattr(self, field)}")

    @property
    def total_steps(self) -> int:
        """Steps of all stages together."""
        return sum(stage.steps for stage in self.stages)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dict of JSON types, the form that checkpoints store."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """A run from nested mappings, as files under `configs/` build them.

        `stages` maps names to fields and runs in the order of the names; `data.sources` and `data.hold_out` map
        data-set names to fields.

        Raises:
          ValueError: An unknown or missing field, or a value out of range; names it and the known ones.
        """
        values = dict(values)
        _check_fields(cls, values, "config")
        stages, data, validation = values["stages"], dict(values["data"]), values["validation"]
        values["model"] = ModelConfig.from_dict(dict(values["model"]))
        values["loss"] = _build(LossConfig, values["loss"], "config.loss")
        values["optimizer"] = _build(OptimizerConfig, values["optimizer"], "config.optimizer")
        values["stages"] = tuple(
            _build(StageConfig, {"name": name, **stages[name]}, f"config.stages.{name}") for name in sorted(stages)
        )
        _check_fields(DataConfig, data, "config.data")
        data["sources"] = tuple(
            _build(SourceConfig, {"name": name, **data["sources"][name]}, f"config.data.sources.{name}")
            for name in sorted(data["sources"])
        )
        data["hold_out"] = tuple(
            (name, _build(HoldOut, rule, f"config.data.hold_out.{name}"))
            for name, rule in sorted(dict(data.get("hold_out", {})).items())
        )
        if data.get("augmentation") is not None:
            data["augmentation"] = _build(ColourAugmentation, data["augmentation"], "config.data.augmentation")
        values["data"] = _build(DataConfig, data, "config.data")
        if validation is not None:
            validation = dict(validation)
            _check_fields(ValidationConfig, validation, "config.validation")
            validation["source"] = _build(SourceConfig, validation["source"], "config.validation.source")
            values["validation"] = _build(ValidationConfig, validation, "config.validation")
        return cls(**values)


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _check_fields(cls: Any, values: Mapping[str, Any], path: str) -> None:
    fields = dataclasses.fields(cls)
    known = [field.name for field in fields]
    for name in values:
        _require(name in known, f"unknown field {path}.{name}; {cls.__name__} knows {', '.join(known)}")
    for field in fields:
        required = field.default is dataclasses.MISSING
        _require(not required or field.name in values, f"missing field {path}.{field.name} of {cls.__name__}; set it")


def _build(cls: Any, values: Mapping[str, Any], path: str) -> Any:
    _check_fields(cls, values, path)
    return cls(**values)
