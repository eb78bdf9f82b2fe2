"""Whole sequences through methods, timed: what is run, how it is measured, and that nothing is measured twice."""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from logvggt_jax.compile import counted_compilations
from logvggt_jax.config import require_counts
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.costs.parts import live_device_bytes
from logvggt_jax.evaluation.environment import code_version, describe_device
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.progress import progress_display
from logvggt_jax.evaluation.records import plain, record_key
from logvggt_jax.files import open_regular, write_text
from logvggt_jax.streaming import METHODS, PredictionError, Predictor

TIMINGS_FILE = "timings.json"
# Distinct pictures; a sequence shows them in turn.
NUM_PICTURES = 16


@dataclasses.dataclass(frozen=True)
class TimingConfig:
    """The sequences that are timed."""

    lengths: tuple[int, ...] = (100, 200, 500, 1000)  # frames of each; none of them times nothing
    rounds: int = 3  # times that each is run, after once that does not count

    def __post_init__(self) -> None:
        object.__setattr__(self, "lengths", tuple(sorted(self.lengths)))
        if any(n < 1 for n in self.lengths) or len(set(self.lengths)) < len(self.lengths):
            raise InputError(
                f"TimingConfig.lengths must be different numbers of frames, 1 or more each, got {self.lengths}"
            )
        require_counts(self, "rounds")


@dataclasses.dataclass(frozen=True)
class StreamTime:
    """One stream: seconds in all, until the first result, of each step; most bytes of arrays alive between frames, and
    most bytes that the stream kept for the frames to come."""

    seconds: float
    first_result: float
    steps: list[float]
    live_bytes: int
    state_bytes: int


def random_pictures(image_size: tuple[int, int]) -> np.ndarray:
    """[16, H, W, 3] uint8."""
    return np.random.default_rng(0).integers(0, 256, (NUM_PICTURES, *image_size, 3), np.uint8)


def unlimited_settings(method: str) -> Any:
    """The defaults of a method, by its name, but that a sequence may have any number of frames."""
    settings = METHODS[method].settings()
    if getattr(settings, "max_frames", None) is None:
        return settings
    return dataclasses.replace(settings, max_frames=None)


def time_stream(predictor: Predictor, pictures: np.ndarray, num_frames: int, *, watch: bool = False) -> StreamTime:
    """Sends `num_frames` frames through a predictor: host pictures in, host depth out, cameras at the end.

    No frame has been pushed to it; `pictures` [N, H, W, 3] uint8 are shown in turn. `watch` looks at memory between
    frames, which takes time of its own. Raises PredictionError where the predictor cannot take so many frames.
    """
    steps: list[float] = []
    first_result, live, state = 0.0, 0, 0
    started = time.perf_counter()
    for index in range(num_frames):
        pushed = time.perf_counter()
        results = predictor.push(pictures[index % len(pictures)])
        if results:
            steps.append(time.perf_counter() - pushed)
            first_result = first_result or time.perf_counter() - started
        if watch:
            live, state = max(live, live_device_bytes()), max(state, predictor.state_bytes)
    predictor.close()
    predictor.cameras()
    return StreamTime(time.perf_counter() - started, first_result, steps, live, state)


def cost_of_length(row: Method, pictures: np.ndarray, length: int, rounds: int) -> dict[str, Any]:
    """What a sequence of so many frames costs a row, JSON values.

    A first run compiles, and looks at memory between frames; `rounds` more are timed.

    Returns:
      `frames_per_second` (their list), `state_bytes` (the most that were kept between two frames) and `compilations`
      (programs made in the timed runs); or `reason` where the row cannot take so many frames.
    """
    assert row.start is not None  # rows of the model have predictors
    try:
        first = time_stream(row.start(), pictures, length, watch=True)
        with counted_compilations() as compilations:
            runs = [time_stream(row.start(), pictures, length) for _ in range(rounds)]
            made = compilations.count
    except PredictionError as error:
        return {"reason": str(error)}
    rates = [length / run.seconds for run in runs]
    return {"frames_per_second": rates, "state_bytes": first.state_bytes, "compilations": made}


def median_rate(cost: Mapping[str, Any]) -> float | None:
    """Frames a second of `cost_of_length`; None where there are none."""
    return statistics.median(cost["frames_per_second"]) if "frames_per_second" in cost else None


def measured_once(
    rows: Sequence[Method],
    config: TimingConfig,
    output: Path,
    setting: Mapping[str, Any],
    finish: Callable[[dict[str, dict[str, Any]]], dict[str, Any]],
    *,
    fresh: bool,
) -> dict[str, Any]:
    """Runs every row at every length, all on the same pictures, unless `output`/timings.json holds that already.

    An evaluation by the same code that goes on in the folder, with the same rows and setting, does not measure again.

    Args:
      rows: of the model, names unique.
      config: what is timed.
      output: folder of the evaluation.
      setting: what else decides the numbers, JSON values, recorded; `image_size` is (H, W) of the pictures.
      finish: what `cost_of_length` gave, by row and length, to the measured part of the report; may measure more.
      fresh: measure again, whatever is there.

    Returns:
      JSON values: `setting`, with `device`, `lengths` and `rounds`, and what `finish` gives.
    """
    setting = {"device": describe_device(), **setting, "lengths": list(config.lengths), "rounds": config.rounds}
    code = [code_version("evaluation/costs"), jax.__version__]
    key = record_key(code, setting, [[row.name, row.identity] for row in rows])
    if not fresh and (found := _kept(output)).get("key") == key:
        return found
    pictures = random_pictures(setting["image_size"])
    costs: dict[str, dict[str, Any]] = {row.name: {} for row in rows}
    with progress_display(None) as progress:
        task = progress.add_task("timing", total=len(rows) * len(config.lengths) + 1)
        for length in config.lengths:
            for row in rows:
                progress.update(task, description=f"timing: {row.name}, {length} frames")
                costs[row.name][str(length)] = cost_of_length(row, pictures, length, config.rounds)
                progress.advance(task)
        progress.update(task, description="timing: parts")
        report = {"key": key, **setting, **finish(costs)}
        progress.advance(task)
    output.mkdir(parents=True, exist_ok=True)
    write_text(output / TIMINGS_FILE, json.dumps(plain(report), indent=1) + "\n")
    return report


def _kept(output: Path) -> dict[str, Any]:
    """What an earlier evaluation measured, or nothing."""
    try:
        with open_regular(output / TIMINGS_FILE) as stream:
            found = json.loads(stream.read())
    except (OSError, ValueError, RecursionError):  # not there, or damaged: measured anew
        return {}
    return found if isinstance(found, dict) else {}
