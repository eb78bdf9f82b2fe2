"""The steps between two log lines, on the terminal and in both files."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from logvggt_jax.training.config import StageConfig, TrainConfig
from logvggt_jax.training.parallel.agreement import from_all
from logvggt_jax.training.reporting.metrics_log import COST, MetricsLog
from logvggt_jax.training.reporting.progress import progress_line
from logvggt_jax.training.reporting.run_times import RunTimes


def report_interval(
    log: MetricsLog,
    step: int,
    values: Mapping[str, float],
    times: RunTimes,
    *,
    config: TrainConfig,
    stage: StageConfig,
    end: int,
    broken_clips: int,
    memory: int | None,
) -> None:
    """Ends the interval of `times` with `step`, which has finished as all before it have, and says what it was like.

    `values` are its means, `stage` is the one that its steps belong to, with `end` its last step. Of `broken_clips`,
    which this process has replaced, the sum over all processes is told, of `memory`, the most bytes that a device of
    this one held, and of the waiting for clips the largest. All processes have to call it at the same point.
    """
    speed = times.read(stage)
    own = (speed.data_share, broken_clips, math.nan if memory is None else memory)
    shares, broken, held = from_all(np.array(own, np.float32)).T
    speed = speed._replace(data_share=float(shares.max()))
    waited = int(shares.argmax()) if len(shares) > 1 else None
    memory = None if np.isnan(held).all() else int(np.nanmax(held))
    values = {**values, "broken_clips": float(broken.sum())}
    log.write(step, values)
    stage_seconds = times.remaining_seconds(step, end)
    later = len(config.stages) - 1 - config.stages.index(stage)
    run_seconds = times.remaining_seconds(step, compilations=later)
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
