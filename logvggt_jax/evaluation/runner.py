"""Runs methods over the clips of benchmarks, one clip at a time, and writes results as they come."""

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from logvggt_jax.compile import out_of_device_memory
from logvggt_jax.errors import InputError, disk_errors, printable
from logvggt_jax.evaluation.clips import load_clip
from logvggt_jax.evaluation.environment import environment
from logvggt_jax.evaluation.methods.method import ClipPrediction, Method
from logvggt_jax.evaluation.plan import Benchmark, Clip, plan_clips
from logvggt_jax.evaluation.progress import progress_display
from logvggt_jax.evaluation.protocols.protocol import Protocol
from logvggt_jax.evaluation.records import FIGURES_FOLDER, PREDICTION, RECORDS_FILE, ClipRecords, plain
from logvggt_jax.evaluation.scores import (
    ClipScore,
    ClipTruth,
    aligned_points,
    clip_score,
    is_measured,
    prepare_truth,
)
from logvggt_jax.evaluation.summary import summarize
from logvggt_jax.files import write_text
from logvggt_jax.metrics import NotMeasurable
from logvggt_jax.streaming import PredictionError

# Bytes of a sequence's name in those of pictures, which have 255 with all that stands around it.
_LONGEST_SEQUENCE = 120


def evaluate(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    output: Path,
    *,
    title: str,
    command: str,
    configuration: Mapping[str, Any],
    checkpoint: str = "",
    max_sequences: int | None = None,
    figures: int = 0,
    fresh: bool = False,
    timings: Callable[[], Mapping[str, Any]] | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Evaluates all methods on the same clips.

    Every clip's metrics are appended to `output`/clips.jsonl as soon as they are known; results.json follows at the
    end. What decides a clip's numbers is their key: the code that measures, the frames and their truth, the images'
    rule, the measures, and the method with its parameters. A later run takes over what it finds under its keys. Results
    of other runs in the folder stay until this one is complete, and then make place for it.

    A clip that is to be drawn and whose pictures are not there is predicted and measured again for the first method.

    Clips that are too short or cannot be read, methods that cannot predict a clip (out of memory among other things),
    and metrics that a clip does not admit, are listed with their reason; means are over the others and carry their
    number beside the number planned. Any other exception is a fault of this package and is not caught.

    Args:
      benchmarks: what is evaluated; those whose data are missing are listed.
      methods: rows of the tables, names unique; the first is the one drawn in figures.
      output: folder, created with the first result.
      title: of the report.
      command: what a reader has to run to get the same numbers.
      configuration: of the run, recorded.
      checkpoint: digest of the parameters, recorded.
      max_sequences: only that many first sequences of each benchmark; None takes all.
      figures: clips of each benchmark that are drawn.
      fresh: measure everything anew, whatever an earlier run has left.
      timings: measures what becomes `timings` of the results, once all clips are done.
      console: where progress is shown; None for the standard one.

    Returns:
      The content of results.json: `title`, `command`, `config`, `methods`, `benchmarks`, `summary` (one entry for each
      benchmark and method), `skipped`, `failures`, `figures`, `environments` (those in which the clips were measured)
      and `timings` where they were asked for.

    Raises:
      InputError: no clip could be evaluated, or no method could predict any.
      ValueError: two methods of one name.
    """
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise ValueError(f"methods must have unique names, got {', '.join(names)}")
    plan, skipped = plan_clips(benchmarks, max_sequences)
    keys = {
        (clip, method.name): clip.key(method)
        for clip in plan
        for method in methods
        if is_measured(method, clip.benchmark.protocol)
    }
    records = ClipRecords(output / RECORDS_FILE, list(keys.values()), environment(), fresh=fresh)
    with progress_display(console) as progress:
        task = progress.add_task("evaluating", total=len(plan))
        drawn: dict[str, int] = {}
        for clip in plan:
            protocol = clip.benchmark.protocol
            progress.update(task, description=printable(f"{protocol.name}: {clip.sequence}"))
            draws = drawn.get(protocol.name, 0) < figures
            drawn[protocol.name] = drawn.get(protocol.name, 0) + draws
            pending = [
                method
                for method in methods
                if (clip, method.name) in keys
                and not _is_done(records, keys[clip, method.name], output if draws and method is methods[0] else None)
            ]
            if pending:
                reason = _run_clip(clip, pending, methods[0], records, keys, output / FIGURES_FOLDER if draws else None)
                if reason:
                    skipped.append({**clip.address, "reason": reason})
            progress.advance(task)
    if not len(records):
        reasons = "; ".join(f"{entry['sequence']}: {entry['reason']}" for entry in skipped[:3])
        missing = "; ".join(sorted({benchmark.missing for benchmark in benchmarks if benchmark.missing}))
        raise InputError(f"no clip could be evaluated ({len(skipped)} skipped; {reasons or missing})")
    if failed := _all_failed(records, keys.values()):
        raise InputError(f"no method could predict any clip; the first says: {failed}")
    results = plain(
        {
            "title": title,
            "command": command,
            "config": dict(configuration),
            "checkpoint": checkpoint,
            "methods": [{"name": m.name, "knows": m.knows, "static": m.static} for m in methods],
            **summarize(benchmarks, methods, plan, skipped, records, keys),
            "skipped": skipped,
            "environments": records.environments,
            **({} if timings is None else {"timings": timings()}),
        }
    )
    _replace_results(results, records, output)
    return results


def _replace_results(results: Mapping[str, Any], records: ClipRecords, output: Path) -> None:
    """Writes results.json, and then removes what belongs to other results."""
    write_text(output / "results.json", json.dumps(results, indent=1) + "\n")
    records.keep_asked()
    old = [output / "report.md", output / "report.html"]
    for pattern in ("*_frames_*.png", "ate_against_views_*.png", "by_length.png"):
        old += (output / FIGURES_FOLDER).glob(pattern)
    for path in old:
        if str(path.relative_to(output)) not in results["figures"]:
            with disk_errors(path):
                path.unlink(missing_ok=True)


def _run_clip(
    clip: Clip,
    pending: Sequence[Method],
    drawn: Method,
    records: ClipRecords,
    keys: Mapping[tuple[Clip, str], str],
    figures: Path | None,
) -> str:
    """Predicts and measures one clip; returns why it could not be read, empty where it could."""
    protocol, dataset = clip.benchmark.protocol, clip.benchmark.dataset
    assert dataset is not None  # the plan has only clips of data sets that are there
    try:
        data = load_clip(dataset, clip.sequence, clip.indices, protocol.images, depth=protocol.needs_depth)
    except (InputError, OSError) as error:
        return str(error)
    truth = prepare_truth(data, protocol.points if any(method.points for method in pending) else None)
    for method in pending:
        pictures: list[str] | None = None
        prediction, score = _predicted(method, truth, protocol)
        if prediction is None and keys[clip, method.name] in records:
            continue  # it was only to be drawn, and what was measured before stays
        if figures is not None and method is drawn and prediction is not None:
            records.claim()
            pictures = _draw(figures, clip, keys[clip, method.name], method, prediction, truth)
        record = {
            **clip.address,
            "method": method.name,
            "frames_used": len(clip.indices),
            "indices": clip.indices,
            "metrics": score.metrics,
            "failures": score.failures,
            "figures": pictures,
        }
        records.add(keys[clip, method.name], record)
    return ""


def _is_done(records: ClipRecords, key: str, drawn_in: Path | None) -> bool:
    """Whether a clip is measured and, where it is to be drawn in an output folder, its pictures are there.

    A record's `figures` are null where nothing was drawn, and empty where there was nothing to draw.
    """
    if key not in records:
        return False
    figures = records[key]["figures"]
    return drawn_in is None or (figures is not None and all((drawn_in / path).is_file() for path in figures))


def _predicted(method: Method, truth: ClipTruth, protocol: Protocol) -> tuple[ClipPrediction | None, ClipScore]:
    """A method's prediction and its metrics; None and the reason where it has none."""
    try:
        prediction = method.predict(truth.clip.images)
    except (PredictionError, MemoryError) as error:
        return None, ClipScore({}, {PREDICTION: str(error) or "out of memory"})
    except jax.errors.JaxRuntimeError as error:
        if not out_of_device_memory(error):
            raise
        return None, ClipScore({}, {PREDICTION: f"out of memory on the device: {str(error).splitlines()[0]}"})
    return prediction, clip_score(method, prediction, truth, protocol)


def _all_failed(records: ClipRecords, keys: Iterable[str]) -> str:
    """The first method's reason where nothing was predicted at all, else nothing."""
    reasons = [records[key]["failures"].get(PREDICTION, "") for key in keys if key in records]
    return reasons[0] if all(reasons) else ""


def _draw(
    folder: Path, clip: Clip, key: str, method: Method, prediction: ClipPrediction, truth: ClipTruth
) -> list[str]:
    """Draws what the benchmark measures; returns the pictures' paths from the output folder.

    Part of their names is the record's key: those of other results stay as they are until these are complete.
    """
    from logvggt_jax.evaluation.report import figures as plots

    protocol, data = clip.benchmark.protocol, truth.clip
    sequence = clip.sequence.replace("/", "_").encode(errors="ignore")[:_LONGEST_SEQUENCE].decode(errors="ignore")
    stem = f"{protocol.name}_{sequence}_from_{clip.indices[0]}_{len(clip.indices)}_frames"
    stem = f"{stem}_{key[:8]}"
    drawn: list[Path] = []
    if method.depth and prediction.depth is not None and data.depth is not None:
        drawn.append(folder / f"{stem}_depth.png")
        plots.depth_panel(drawn[-1], data.images, data.depth, prediction.depth)
    if method.pose and np.isfinite(data.extrinsics).all() and np.isfinite(prediction.extrinsics).all():
        drawn.append(folder / f"{stem}_trajectory.png")
        plots.trajectory_plot(drawn[-1], prediction.extrinsics, data.extrinsics)
    if method.points and truth.points is not None and truth.indices is not None:
        with contextlib.suppress(NotMeasurable):  # without an alignment there is no picture; the score says why
            points = aligned_points(prediction, truth)
            frames, pixels = np.divmod(truth.indices, data.images[0, ..., 0].size)
            colours = data.images.reshape(len(data.images), -1, 3)[frames, pixels]
            plots.point_clouds(folder / f"{stem}_points.png", points, truth.points, colours, data.extrinsics[0])
            drawn.append(folder / f"{stem}_points.png")
    return [str(path.relative_to(folder.parent)) for path in drawn]
