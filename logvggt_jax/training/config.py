"""Everything that a training run can be told, as frozen dataclasses: validated on construction, hashable.

There are no hyperparameters in code: files under `configs/` state them all.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

from logvggt_jax.config import (
    ModelConfig,
    check_size,
    freeze_lists,
    from_mapping,
    require_counts,
    require_one_of,
    require_within,
    to_mapping,
)
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.holdouts import HoldOut
from logvggt_jax.data.option_fields import given_options
from logvggt_jax.errors import InputError
from logvggt_jax.files import user_path

LOSSES = ("log_vggt", "vggt", "distillation")
SCHEDULES = ("cosine", "linear_tail")
ALGORITHMS = ("adamw", "muon")
# What validation measures of a model, and whether more of it is better.
VALIDATION_METRICS = {
    "abs_rel": False,
    "delta_1.25": True,
    "rotation": False,
    "translation_direction": False,
    "auc_30": True,
}


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """The objective: `name` is `log_vggt` (the paper's), `vggt` (VGGT's released trainer) or `distillation`.

    `translation_weight`, `rotation_weight` and `field_of_view_weight` weigh the parts of the camera loss, `gamma`
    decays earlier rounds of the camera head, `alpha` rewards confidence; in a distillation it weighs the distance to
    the teacher's. `quantile` (vggt only), in whole hundredths, drops the largest depth errors, None keeps all.
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
        require_one_of(self, LOSSES, "name")
        weights = ("translation_weight", "rotation_weight", "field_of_view_weight")
        require_within(self, "[0, inf)", "camera_weight", "depth_weight", *weights, "alpha")
        require_within(self, "(0, 1]", "gamma", "quantile")
        if self.quantile is not None and abs(100 * self.quantile - round(100 * self.quantile)) > 1e-6:
            raise InputError(f"LossConfig.quantile must be in whole hundredths, such as 0.98, got {self.quantile}")


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """AdamW or Muon, with clipping by module.

    `algorithm` "muon" moves the matrices of linear layers by their orthogonalised momentum, and all else as "adamw"
    does; a learning rate means about the same for both.
    The rate climbs linearly over `warmup_fraction` of the schedule and then follows a `cosine`, or stays and
    falls linearly over the last quarter (`linear_tail`), to `final_learning_rate`. With `restart_each_stage` every
    stage of the curriculum runs the schedule anew. `decay_all` applies weight decay to vectors (biases, norms,
    gains) too. Parameters whose names match one of the patterns `frozen` (see `freezing`) are not trained; the encoder
    is one of them where `model.encoder.frozen` says so.
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
    frozen: tuple[str, ...] = ()
    algorithm: str = "adamw"

    def __post_init__(self) -> None:
        freeze_lists(self)
        require_one_of(self, SCHEDULES, "schedule")
        require_one_of(self, ALGORITHMS, "algorithm")
        require_within(self, "(0, inf)", "learning_rate", "clip_norm")
        require_within(self, "[0, inf)", "final_learning_rate", "weight_decay")
        require_within(self, "[0, 1)", "b1", "b2")
        require_within(self, "[0, 0.75)", "warmup_fraction")


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
        freeze_lists(self)
        require_counts(self, "steps", "clip_length", "batch_size", "min_stride", "max_stride")
        if self.min_stride > self.max_stride:
            raise InputError(f"StageConfig.min_stride={self.min_stride} exceeds max_stride={self.max_stride}")
        if not self.sizes:
            raise InputError("StageConfig.sizes is empty, give at least one (height, width)")
        for size in self.sizes:
            check_size(size, "StageConfig.sizes")
        if len(set(self.sizes)) < len(self.sizes):
            raise InputError(f"StageConfig.sizes must be different (height, width), got {self.sizes}")

    @property
    def clip_shapes(self) -> frozenset[tuple[int, ...]]:
        """Shapes of its batches' images, (B, T, H, W, 3): each is a program of its own."""
        return frozenset((self.batch_size, self.clip_length, *size, 3) for size in self.sizes)


@dataclasses.dataclass(frozen=True)
class SourceConfig:
    """One data set of a mixture.

    `weight` is its share of the clips relative to the others'. `stride`, smallest and largest, takes the place of
    the stage's. Of every sequence the `frames`, first and the one after the last, are taken, as a slice of Python does:
    (None, 700) the first 700, (-200, None) the last 200. `options` (sorted pairs) are further arguments of the set's
    reader; those that are None are its defaults.
    """

    name: str
    root: str | None
    split: str
    weight: float = 1.0
    stride: tuple[int, int] | None = None
    frames: tuple[int | None, int | None] | None = None
    options: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        freeze_lists(self)
        _expand_home(self, "root")
        object.__setattr__(self, "options", tuple(sorted(given_options(dict(self.options)).items())))
        require_within(self, "(0, inf)", "weight")
        if self.stride is not None and not (len(self.stride) == 2 and 1 <= self.stride[0] <= self.stride[1]):
            raise InputError(f"SourceConfig.stride must be a pair 1 <= low <= high, got {self.stride}")


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """The training mixture.

    Clips run backwards in time with probability `reverse`. `worker_count` processes read ahead (0: none, this
    process reads), each with `num_threads` threads. What a set has to make first, such as pictures of procedural
    rooms, is kept in `cache_dir`, in memory if None.
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
        _expand_home(self, "cache_dir")
        object.__setattr__(self, "hold_out", tuple(sorted(self.hold_out, key=lambda pair: pair[0])))
        if not self.sources:
            raise InputError("DataConfig.sources is empty: name at least one data set")
        _require_different(self.sources, "DataConfig.sources")
        require_within(self, "[0, 1]", "reverse")
        require_counts(self, "worker_count", "num_threads", least=0)
        require_within(self, "[0, 1)", "min_valid_depth", "max_broken")


@dataclasses.dataclass(frozen=True)
class ValidationConfig:
    """Every `every` steps, `num_clips` fixed clips of `clip_length` frames, `stride` apart, of each of some held-out
    sets. The model of the best value of the metric `best` is kept, None keeps none.

    They come from as many sequences as a set has; where those are fewer, from several places of each. The sources have
    no stride or weight of their own.
    """

    sources: tuple[SourceConfig, ...]
    every: int
    num_clips: int
    clip_length: int
    stride: int
    size: tuple[int, int]
    best: str | None = None

    def __post_init__(self) -> None:
        freeze_lists(self)
        if not self.sources:
            raise InputError("ValidationConfig.sources is empty: name at least one data set, or set validation to None")
        _require_different(self.sources, "ValidationConfig.sources")
        for source in self.sources:
            if source.stride is not None or source.weight != 1.0:
                raise InputError(
                    f"ValidationConfig.sources: {source.name} has a stride or weight of its own, which training alone "
                    "knows: leave it out; all clips of validation are validation.stride apart, as many of each source"
                )
        if self.best is not None:
            require_one_of(self, tuple(VALIDATION_METRICS), "best")
        require_counts(self, "every", "num_clips", "clip_length", "stride")
        if self.clip_length < 2:
            raise InputError("ValidationConfig.clip_length must be at least 2: pose errors are of pairs of frames")
        check_size(self.size, "ValidationConfig.size")


@dataclasses.dataclass(frozen=True)
class TeacherConfig:
    """Plain VGGT, whose predictions take the place of the truth in all sources of a run.

    `weights` is what `from_pretrained` reads. Videos are cut into clips of `clip_length` frames, `stride` apart, each
    of which the teacher sees as a whole: the longer, the more a student learns of what lies far apart, up to what a
    device's memory holds. Its labels are kept in `data.cache_dir`. With `validation` the validation source is labelled
    as well and the student compared with its teacher, else with that source's truth.
    """

    weights: str
    clip_length: int
    stride: int = 1
    validation: bool = True

    def __post_init__(self) -> None:
        require_counts(self, "clip_length", "stride")
        if self.clip_length < 2:
            raise InputError("TeacherConfig.clip_length must be at least 2: one frame alone has no pose to be learned")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole run.

    `initial_weights` is what `from_pretrained` reads (a path, `rooms`, a hub repository), None starts from random
    numbers. The run stops in good order after `max_minutes`, and with an error after `max_skipped_in_a_row` updates in
    a row that were not finite. `save_every` steps, and at the end, it writes a checkpoint and keeps the latest
    `keep_checkpoints`.

    Each device takes its share of a batch in `accumulate` parts, one after the other, for the gradient of
    `accumulate` times as many devices. With `shard_parameters` a device holds its part of parameters, gradients and
    moments, and puts the parameters together layer by layer. `average`, such as 0.999, is the decay in a step of a
    moving average of the parameters, which validation and the model folder then have; None keeps none. The first two
    may change when a run goes on. A `teacher` labels the data, for the objective `distillation`; all stages then have
    the same `sizes`.
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
    accumulate: int = 1
    shard_parameters: bool = False
    average: float | None = None
    teacher: TeacherConfig | None = None

    def __post_init__(self) -> None:
        if not self.stages:
            raise InputError("TrainConfig.stages is empty: a run needs at least one")
        if (self.loss.name == "distillation") != (self.teacher is not None):
            raise InputError("loss.name='distillation' and a teacher belong together: give both, or neither")
        if self.teacher is not None:
            if self.data.cache_dir is None:
                raise InputError("a teacher's labels are kept on disk: give data.cache_dir a folder")
            if longest := [s.name for s in self.stages if s.clip_length > self.teacher.clip_length]:
                raise InputError(
                    f"stages {', '.join(longest)}: clips are longer than the teacher's, "
                    f"teacher.clip_length={self.teacher.clip_length}: raise it or shorten them"
                )
            # Each clip is labelled once, at the one size of the run's that is nearest to its own.
            if other := [s.name for s in self.stages if set(s.sizes) != set(self.stages[0].sizes)]:
                raise InputError(
                    f"stages {', '.join(other)}: sizes differ from those of {self.stages[0].name}; a teacher labels "
                    "every clip at one size: give all stages the same sizes"
                )
        if self.shard_parameters and self.optimizer.algorithm == "muon":
            raise InputError(
                "optimizer.algorithm='muon' turns whole matrices, of which shard_parameters=True leaves each device a "
                "part: take optimizer.algorithm='adamw', or shard_parameters=False"
            )
        require_counts(self, "log_every", "save_every", "keep_checkpoints", "max_skipped_in_a_row", "accumulate")
        require_counts(self, "seed", least=0)
        require_within(self, "[0, 1)", "average")
        require_within(self, "(0, inf)", "max_minutes")

    @property
    def total_steps(self) -> int:
        """Steps of all stages together."""
        return sum(stage.steps for stage in self.stages)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dict of JSON types, the form that checkpoints store."""
        return to_mapping(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """A run from nested mappings, as files under `configs/` build them; inverse of `to_dict`.

        `stages` and `data.sources` may map names to the other fields, `data.hold_out` maps names of data sets to
        rules. Stages run in the order written. A mapping that was sorted by name (ml_collections' ConfigDict does
        so, unless made with `sort_keys=False`) has lost it: its stages run in the order of the numbers in their
        names, stage_2 before stage_10.

        Raises:
          InputError: as `from_mapping`.
        """
        stages = values.get("stages")
        if isinstance(stages, Mapping) and list(stages) == sorted(stages):
            values = {**values, "stages": {name: stages[name] for name in sorted(stages, key=_numbers_by_value)}}
        return from_mapping(cls, values, "config")


def _expand_home(config: SourceConfig | DataConfig, name: str) -> None:
    """Expands `~` in a field that is a folder, as a shell leaves it behind `=`; InputError where it is empty."""
    folder = getattr(config, name)
    if folder is None:
        return
    try:
        path = user_path(folder)
    except InputError as error:
        raise InputError(f"{type(config).__name__}.{name}={folder!r}: {error}") from error
    # Other folders stay as they are written: validation tells its sets apart by them.
    if folder.startswith("~"):
        object.__setattr__(config, name, str(path))


def _require_different(sources: Sequence[SourceConfig], field: str) -> None:
    """Raises InputError where a data set stands twice: its sequences have one set of names, and it one stride."""
    names = [source.name for source in sources]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{field}: {name} is named twice; one folder of it may hold several sequences")


def _numbers_by_value(name: str) -> list[tuple[int, str]]:
    return [(int(part) if part.isdecimal() else 0, part) for part in re.split(r"(\d+)", name)]
