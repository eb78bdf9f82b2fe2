"""The steps between two log lines, on the terminal and in both files."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from logvggt_jax.training.config import StageConfig, TrainConfig
from logvggt_jax.training.reporting.metrics_log import COST, MetricsLog
from logvggt_jax.training.reporting.progress import progress_line
from logvggt_jax.training.reporting.run_times import RunTimes, Speed


def own_facts(speed: Speed, *, broken_clips: int, memory: int | None) -> np.ndarray:
    """float32 [3]: what a process tells the others of an interval: its waiting for clips, the clips that it has
    replaced so far, and the most bytes that a device of it held, NaN where that is not known."""
    return np.array([speed.data_share, broken_clips, math.nan if memory is None else memory], np.float32)


def report_interval(
    log: MetricsLog,
    step: int,
    values: Mapping[str, float],
    times: RunTimes,
    speed: Speed,
    facts: np.ndarray,
    *,
    config: TrainConfig,
    stage: StageConfig,
    end: int,
) -> None:
    """Says what the interval was like that `step` has ended, which has finished as all before it have.

    `values` are its means and `speed` is its, as `times` told; `stage` is the one that its steps belong to, with `end`
    its last step. Of the `facts` of all processes, [processes, 3] as `own_facts` gives them, the longest waiting, the
    sum of the broken clips and the fullest device are told.
    """
    shares, broken, held = facts.T
    speed = speed._replace(data_share=float(shares.max()))
    waited = int(shares.argmax()) if len(shares) > 1 else None
    memory = None if np.isnan(held).all() else int(np.nanmax(held))
    values = {**values, "broken_clips": float(broken.sum())}
    log.write(step, values)
    stage_seconds = times.remaining_seconds(step, end)
    run_seconds = times.remaining_seconds(step)
    log.write_times(
        step,
        {
            "productive_seconds": times.productive,
            "frames_per_second": speed.frames_per_second,
            "data_share": speed.data_share,
            "stage_seconds_left": stage_seconds,
            "run_seconds_left": run_seconds,
            **{f"{COST}{kind}": seconds for kind, seconds in times.costs.items()},
            **({} if speed.utilisation is None else {"utilisation": speed.utilisation}),
            **({} if memory is None else {"device_gib": memory / 2**30}),
        },
    )
    log.say(
        progress_line(
            step,
            config.total_steps,
            stage.name,
            values,
            speed,
            waited=waited,
            memory=memory,
            stage_seconds=stage_seconds,
            run_seconds=run_seconds,
        )
    )
