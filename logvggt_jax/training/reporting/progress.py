"""The line that the terminal shows of some steps: their means, their speed, and how long the run will still take."""

import math
from collections.abc import Mapping

from logvggt_jax.training.reporting.run_times import Speed

_LAST_OF_INTERVAL = ("learning_rate", "skipped", "longest_skip")


class IntervalMeans:
    """The mean of each value that the steps between two log lines report; values that are not finite do not count."""

    def __init__(self) -> None:
        self._values: dict[str, list[float]] = {}

    def add(self, values: Mapping[str, float]) -> None:
        """Takes the values of one step."""
        for name, value in values.items():
            self._values.setdefault(name, []).append(value)

    def read(self) -> dict[str, float]:
        """The mean of each value since the last call; of counters and the learning rate the last value instead."""
        values, self._values = self._values, {}
        return {name: found[-1] if name in _LAST_OF_INTERVAL else _mean(found) for name, found in values.items()}


def progress_line(
    step: int,
    total: int,
    stage: str,
    values: Mapping[str, float],
    speed: Speed,
    *,
    waited: int | None = None,
    memory: int | None,
    stage_seconds: float,
    run_seconds: float,
) -> str:
    """One line about an interval's steps: loss with its terms, errors, learning rate, speed and remaining time.

    `values` are its means as they are logged, `memory` the most bytes that a device held; `waited` is the process that
    has waited longest for clips, where there are several.
    """
    terms = {name: value for name, value in values.items() if name.startswith("loss/") and name != "loss/total"}
    parts = [
        f"loss {values['loss/total']:.4f} ("
        + ", ".join(f"{name.removeprefix('loss/')} {value:.4g}" for name, value in terms.items())
        + ")",
        f"abs_rel {values['train/abs_rel']:.3f}",
        f"rotation {values['train/rotation_over_identity']:.2f} of identity's",
        f"direction {values['train/translation_direction']:.0f}°",
        f"rate {values['learning_rate']:.2e}",
        f"{speed.frames_per_second:.0f} frames/s",
    ]
    if speed.utilisation is not None:
        parts.append(f"utilisation {speed.utilisation:.2f}")
    who = "" if waited is None else f" (process {waited})"
    parts.append(f"waiting for data {speed.data_share:.0%}{who}")
    if memory is not None:
        parts.append(f"memory {memory / 2**30:.1f} GiB")
    left = f"{duration(stage_seconds)} left of the stage, {duration(run_seconds)} of the run"
    return f"step {step}/{total} {stage}: {', '.join(parts)}, {left}"


def goodput(productive: float, wall: float | None) -> str:
    """The share of the time since the first start that went into training, in words.

    Args:
      productive: seconds of the steps that made the present state.
      wall: seconds since the first start, by a clock that may have been set between two starts; None where it was
        set within one.
    """
    done = f"{duration(productive)} of training"
    if wall is None:
        return f"goodput not known, {done}: the clock was set since the first start"
    if wall < productive or wall <= 0:
        return f"goodput not known, {done} in less time: the clock was set back since the first start"
    return f"goodput {productive / wall:.0%}: {done} in {duration(wall)} since the first start"


def duration(seconds: float) -> str:
    """Seconds as hours, minutes and seconds, 1:02:03, or as minutes and seconds, 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _mean(values: list[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else math.nan
