"""Runs methods over the clips of a data set, one clip in memory at a time, and writes results as they come."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO, TypeVar

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.transforms import fit
from logvggt_jax.evaluation.methods import ClipPrediction, Method
from logvggt_jax.evaluation.protocols import ClipScore, ClipTruth, clip_score, data_set_score, prepare_truth
from logvggt_jax.evaluation.references import ReferenceConfig
from logvggt_jax.types import Frames

Settings = TypeVar("Settings")

_VERSIONED = ("logvggt-jax", "jax", "jaxlib", "flax", "numpy", "scipy", "evo", "open3d")


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """Which clips are evaluated and how.

    Attributes:
      image_size: (H, W) of the model's input, multiples of 14; frames are resized and cropped to it.
      clip_lengths: frames of a clip; the model is compiled once for each.
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
            value = getattr(self, name)
            if value is not None and not isinstance(value, int):
                raise ValueError(f"{name} must be a whole number, got {value!r}")
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if self.icp_threshold is not None and not self.icp_threshold > 0:
            raise ValueError(f"icp_threshold must be positive or None, got {self.icp_threshold}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EvaluationConfig:
        """From a configuration file's mapping; ValueError for an unknown or missing field, naming it."""
        return _from_mapping(cls, values, "evaluation.")


@dataclasses.dataclass(frozen=True)
class EvaluationRun:
    """What a file of `configs/eval` says.

    Attributes:
      title: of the report.
      dataset: one of `logvggt_jax.data.DATASETS`.
      split: `train`, `val`, `test` or `all`.
      baselines: whether the baselines are evaluated beside the network.
      evaluation: clips and metrics.
      rooms: options of procedural rooms, for `dataset` = `rooms` alone.
      references: limits of the reference models; None leaves them out.
      variants: names of `logvggt_jax.evaluation.variants.VARIANTS` that are evaluated beside the network.
    """

    title: str
    dataset: str
    split: str
    baselines: bool
    evaluation: EvaluationConfig
    rooms: Mapping[str, Any] | None = None
    references: ReferenceConfig | None = None
    variants: tuple[str, ...] = ()

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EvaluationRun:
        """From a configuration file's mapping; ValueError for an unknown or missing field, naming it."""
        run = _from_mapping(cls, values, "")
        limits = values.get("references")
        return dataclasses.replace(
            run,
            evaluation=EvaluationConfig.from_dict(values["evaluation"]),
            references=None if limits is None else _from_mapping(ReferenceConfig, limits, "references."),
            variants=tuple(run.variants),
        )


def _from_mapping(cls: type[Settings], values: Mapping[str, Any], prefix: str) -> Settings:
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    known = [field.name for field in fields]
    for name in values:
        if name not in known:
            raise ValueError(f"unknown field {prefix}{name}; known are {', '.join(known)}")
    for field in fields:
        if field.name not in values and field.default is dataclasses.MISSING:
            raise ValueError(f"field {prefix}{field.name} is missing from the configuration")
    return cls(**values)


@dataclasses.dataclass(frozen=True)
class Clip:
    """Frames `indices` of `sequence`."""

    sequence: str
    indices: tuple[int, ...]


def evaluate(
    dataset: Dataset,
    methods: Sequence[Method],
    config: EvaluationConfig,
    output: Path,
    *,
    title: str,
    command: str,
    console: Console | None = None,
) -> dict[str, Any]:
    """Evaluates all methods on the same clips.

    Every clip's metrics are appended to `output`/clips.jsonl as soon as they are known; results.json follows at the
    end. After an error clips.jsonl is gone, after an interruption it holds the clips that were done. Clips that are
    too short or cannot be read, and metrics that a clip does not admit, are listed with their reason in the results;
    means are over the others and carry their number.

    Args:
      dataset: a `logvggt_jax.data` data set.
      methods: rows of the table; the first is the one drawn in figures.
      config: clips and metrics.
      output: folder, created; results of an earlier run in it are replaced.
      title: of the report.
      command: what a reader has to run to get the same numbers.
      console: where progress is shown; None for the standard one.

    Returns:
      The content of results.json: `title`, `command`, `config`, `methods`, `summary` (one entry for each clip length
      and method), `skipped`, `failures`, `versions`, `device`.

    Raises:
      ValueError: no clip could be evaluated.
    """
    plan, skipped = plan_clips(dataset, config)
    output.mkdir(parents=True, exist_ok=True)
    for stale in (output / "results.json", output / "report.md", *(output / "figures").glob("*_frames_*.png")):
        stale.unlink(missing_ok=True)
    scores: dict[tuple[int, str], list[ClipScore]] = {}
    failures: list[dict[str, Any]] = []
    drawn: dict[int, int] = {}
    with _line_file(output / "clips.jsonl") as lines, _progress(console) as progress:
        task = progress.add_task("evaluating", total=len(plan))
        for clip in plan:
            length = len(clip.indices)
            progress.update(task, description=f"{clip.sequence}, {length} frames")
            try:
                frames = fit(dataset.read(clip.sequence, clip.indices), config.image_size)
            except (ValueError, OSError) as error:
                skipped.append({"sequence": clip.sequence, "frames": length, "reason": str(error)})
                progress.advance(task)
                continue
            truth = prepare_truth(
                frames,
                max_points=config.max_points,
                seed=config.seed,
                points=any(method.points for method in methods),
            )
            for position, method in enumerate(methods):
                prediction = method.predict(frames.images)
                score = clip_score(method, prediction, truth, icp_threshold=config.icp_threshold)
                scores.setdefault((length, method.name), []).append(score)
                where = {"sequence": clip.sequence, "frames": length, "method": method.name}
                failures.extend({**where, "metric": group, "reason": why} for group, why in score.failures.items())
                record = {**where, "indices": clip.indices, "metrics": score.metrics, "failures": score.failures}
                lines.write(json.dumps(_plain(record)) + "\n")
                lines.flush()
                if position == 0 and drawn.get(length, 0) < config.figures:
                    drawn[length] = drawn.get(length, 0) + 1
                    _draw(output / "figures", clip, method, prediction, truth)
            progress.advance(task)
        if not scores:
            reasons = "; ".join(f"{entry['sequence']}: {entry['reason']}" for entry in skipped[:3])
            raise ValueError(f"no clip could be evaluated ({len(skipped)} skipped; {reasons})")
    results: dict[str, Any] = {
        "title": title,
        "command": command,
        "config": dataclasses.asdict(config),
        "methods": [{"name": m.name, "knows": m.knows, "static": m.static} for m in methods],
        "summary": [
            {"frames": length, "method": name, **data_set_score(clips)} for (length, name), clips in scores.items()
        ],
        "skipped": skipped,
        "failures": failures,
        "versions": {name: _version(name) for name in _VERSIONED},
        "device": str(jax.devices()[0].device_kind),
    }
    results = _plain(results)
    write_text(output / "results.json", json.dumps(results, indent=1) + "\n")
    return results


def plan_clips(dataset: Dataset, config: EvaluationConfig) -> tuple[list[Clip], list[dict[str, Any]]]:
    """Clips in order of length, then sequence; and the sequences too short for a length, with the reason."""
    clips: list[Clip] = []
    skipped: list[dict[str, Any]] = []
    sequences = list(dataset.sequences)[: config.max_sequences]
    for length in config.clip_lengths:
        span = (length - 1) * config.stride + 1
        for sequence in sequences:
            count = dataset.num_frames(sequence)
            if count < span:
                reason = f"has {count} frames, {length} at stride {config.stride} need {span}"
                skipped.append({"sequence": sequence, "frames": length, "reason": reason})
                continue
            starts = np.unique(np.linspace(0, count - span, config.clips_per_sequence).round().astype(int))
            clips += [Clip(sequence, tuple(range(int(start), int(start) + span, config.stride))) for start in starts]
    return clips, skipped


def write_text(path: Path, text: str) -> None:
    """Writes a file whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _line_file(path: Path) -> Iterator[TextIO]:
    """A file of whole lines; an error takes it away again, and its folder if nothing else is there."""
    try:
        with path.open("w") as lines:
            yield lines
    except Exception:
        path.unlink(missing_ok=True)
        if not any(path.parent.iterdir()):
            path.parent.rmdir()
        raise


@contextlib.contextmanager
def _progress(console: Console | None) -> Iterator[Progress]:
    columns = (TextColumn("{task.description:<32}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        yield progress


def _draw(folder: Path, clip: Clip, method: Method, prediction: ClipPrediction, truth: ClipTruth) -> None:
    from logvggt_jax.evaluation import plots

    frames: Frames = truth.frames
    stem = f"{clip.sequence.replace('/', '_')}_from_{clip.indices[0]}_{len(clip.indices)}_frames"
    if method.depth and prediction.depth is not None:
        plots.depth_panel(folder / f"{stem}_depth.png", frames.images, frames.depth, prediction.depth)
    if method.pose and np.isfinite(frames.extrinsics).all():
        plots.trajectory_plot(folder / f"{stem}_trajectory.png", prediction.extrinsics, frames.extrinsics)


def _plain(value: Any) -> Any:
    """Values as JSON knows them: a number that is not finite becomes null."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
