"""What each method costs as sequences grow: frames a second, bytes kept, programs compiled after the first run."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from logvggt_jax.compile import counted_compilations
from logvggt_jax.evaluation.costs.throughput import (
    TimingConfig,
    keep_timings,
    kept_timings,
    random_pictures,
    time_stream,
)
from logvggt_jax.evaluation.environment import code_version, describe_device
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.progress import progress_display
from logvggt_jax.evaluation.records import record_key
from logvggt_jax.streaming import PredictionError


def measured_costs(
    rows: Sequence[Method],
    config: TimingConfig,
    output: Path,
    *,
    image_size: tuple[int, int],
    dtype: str,
    fresh: bool = False,
) -> dict[str, Any]:
    """The costs of rows that have predictors, all in one run and on the same pictures.

    `output`/timings.json keeps them: an evaluation by the same code that goes on in the folder, on the same device,
    does not measure again.

    Args:
      rows: of the model, names unique.
      config: what is timed.
      output: folder of the evaluation.
      image_size: (H, W) of the pictures.
      dtype: compute type of the model, recorded.
      fresh: measure again, whatever is there.

    Returns:
      JSON values: `device`, `dtype`, `image_size`, `lengths`, `rounds`, and `costs` (by row and length, as
      `cost_of_length` gives them).
    """
    setting = {
        "device": describe_device(),
        "dtype": dtype,
        "image_size": list(image_size),
        "lengths": list(config.lengths),
        "rounds": config.rounds,
    }
    code = [code_version("evaluation/costs"), jax.__version__]
    key = record_key(code, setting, [[row.name, row.identity] for row in rows])
    if not fresh and (found := kept_timings(output)).get("key") == key:
        return found
    pictures = random_pictures(image_size)
    costs: dict[str, dict[str, Any]] = {row.name: {} for row in rows}
    with progress_display(None) as progress:
        task = progress.add_task("timing", total=len(rows) * len(config.lengths))
        for length in config.lengths:
            for row in rows:
                progress.update(task, description=f"timing: {row.name}, {length} frames")
                costs[row.name][str(length)] = cost_of_length(row, pictures, length, config.rounds)
                progress.advance(task)
    report = {"key": key, **setting, "costs": costs}
    keep_timings(output, report)
    return report


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
            made = compilations()
    except PredictionError as error:
        return {"reason": str(error)}
    rates = [length / run.seconds for run in runs]
    return {"frames_per_second": rates, "state_bytes": first.state_bytes, "compilations": made}


def median_rate(cost: Mapping[str, Any]) -> float | None:
    """Frames a second of `cost_of_length`; None where there are none."""
    return statistics.median(cost["frames_per_second"]) if "frames_per_second" in cost else None
