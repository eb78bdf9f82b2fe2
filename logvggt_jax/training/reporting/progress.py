"""Where a run's time goes, how long it will still take, and the line that the terminal shows of it."""

import contextlib
import math
import time
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from logvggt_jax.training.config import StageConfig, TrainConfig

_LAST_OF_INTERVAL = ("learning_rate", "skipped", "longest_skip")


class Speed(NamedTuple):
    """Of the steps of one interval between two log lines.

    Attributes:
      seconds: that the steps took together, without compilations, validations and saves.
      frames_per_second: frames trained on.
      data_share: part of the time in which the host waited for clips.
      utilisation: operations a second (forward and gradient, nothing computed twice) over those of the fastest large
        matrix product on all devices; None where that is not known.
    """

    seconds: float
    frames_per_second: float
    data_share: float
    utilisation: float | None


class RunTimes:
    """Measures what a session of a run spends its time on.

    The loop calls `count` after each step and `read` when it logs and the last step has finished; it enters `waiting`
    to get a batch, and `other` for what is no step.

    Attributes:
      productive: seconds of the steps that made the present state, those of earlier sessions too.
    """

    def __init__(self, config: TrainConfig, *, productive: float = 0.0, peak: float | None = None) -> None:
        """Args: `peak` is operations a second of all devices at their best."""
        self.productive = productive
        self._config, self._peak = config, peak
        self._others: dict[str, list[float]] = {}
        self._seconds_a_frame: float | None = None
        self.begin()

    def begin(self) -> None:
        """Begins an interval, without what came before."""
        self._started, self._elsewhere, self._waited = time.perf_counter(), 0.0, 0.0
        self._steps, self._operations = 0, 0.0

    def count(self, operations: float = 0.0) -> None:
        """Notes that one more step was started, of so many operations."""
        self._steps += 1
        self._operations += operations

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Time in which the host waits for clips; a part of the steps' time."""
        started = time.perf_counter()
        yield
        self._waited += time.perf_counter() - started

    @contextlib.contextmanager
    def other(self, kind: str) -> Iterator[None]:
        """Time of a `compilation`, `validation` or `save`, in which no step runs."""
        started = time.perf_counter()
        yield
        self._others.setdefault(kind, []).append(time.perf_counter() - started)
        self._elsewhere += self._others[kind][-1]

    def read(self, stage: StageConfig) -> Speed:
        """Ends the interval, whose steps all belong to `stage`, and begins the next."""
        seconds = max(time.perf_counter() - self._started - self._elsewhere, 1e-9)
        self.productive += max(seconds - self._waited, 0.0)
        frames = self._steps * _frames(stage)
        if frames:
            self._seconds_a_frame = seconds / frames
        known = self._peak is not None and self._operations > 0
        speed = Speed(
            seconds=seconds,
            frames_per_second=frames / seconds,
            data_share=min(self._waited / seconds, 1.0),
            utilisation=self._operations / seconds / self._peak if known and self._peak else None,
        )
        self.begin()
        return speed

    def remaining_seconds(self, step: int, end: int | None = None, *, compilations: int = 0) -> float:
        """Seconds until step `end` (None: the last of all), if frames, validations and saves take as long as so far.

        The steps of `compilations` more stages are still to be compiled.
        """
        config = self._config
        end = config.total_steps if end is None else end
        frames, begin = 0, 0
        saves = end // config.save_every - step // config.save_every
        for stage in config.stages:
            first, begin = begin, begin + stage.steps
            frames += _frames(stage) * max(min(begin, end) - max(first, step), 0)
            # The last step of a stage is saved whatever its number.
            saves += step < begin <= end and begin % config.save_every > 0
        validations = 0
        if config.validation is not None:
            every = config.validation.every
            validations = end // every - step // every + (step < end == config.total_steps and end % every > 0)
        counts = {"save": saves, "validation": validations, "compilation": compilations}
        return frames * (self._seconds_a_frame or 0.0) + sum(
            count * sum(self._others[kind]) / len(self._others[kind])
            for kind, count in counts.items()
            if kind in self._others
        )


class IntervalMeans:
    """Means of what the steps between two log lines say; finite values alone count."""

    def __init__(self) -> None:
        self._values: dict[str, list[float]] = {}

    def add(self, values: Mapping[str, float]) -> None:
        """Takes the values of one step."""
        for name, value in values.items():
            self._values.setdefault(name, []).append(value)

    def read(self) -> dict[str, float]:
        """The means, of counters and the learning rate the last value; then begins anew."""
        values, self._values = self._values, {}
        return {name: found[-1] if name in _LAST_OF_INTERVAL else _mean(found) for name, found in values.items()}


def progress_line(
    step: int,
    total: int,
    stage: str,
    values: Mapping[str, float],
    speed: Speed,
    *,
    memory: int | None,
    stage_seconds: float,
    run_seconds: float,
) -> str:
    """One line about an interval's steps: loss with its terms, errors, learning rate, speed and remaining time.

    `values` are its means as they are logged, `memory` the most bytes that a device held.
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
    parts.append(f"waiting for data {speed.data_share:.0%}")
    if memory is not None:
        parts.append(f"memory {memory / 2**30:.1f} GiB")
    left = f"{duration(stage_seconds)} left of the stage, {duration(run_seconds)} of the run"
    return f"step {step}/{total} {stage}: {', '.join(parts)}, {left}"


def goodput(productive: float, wall: float) -> str:
    """Productive seconds as a part of those since the first start, in words; the latter are of a clock that people and
    machines set."""
    done = f"{duration(productive)} of training"
    if wall < productive or wall <= 0:
        return f"goodput not known, {done} in less time: the clock was set back since the first start"
    return f"goodput {productive / wall:.0%}: {done} in {duration(wall)} since the first start"


def duration(seconds: float) -> str:
    """Seconds as hours, minutes and seconds, 1:02:03, or as minutes and seconds, 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _frames(stage: StageConfig) -> int:
    return stage.batch_size * stage.clip_length


def _mean(values: list[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else math.nan
