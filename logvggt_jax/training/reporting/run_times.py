"""Where a run's time goes, and how long it will still take."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from logvggt_jax.training.config import StageConfig, TrainConfig


class Speed(NamedTuple):
    """Of the steps of one interval between two log lines.

    Attributes:
      frames_per_second: frames trained on.
      data_share: part of the time in which the host waited for clips.
      utilisation: operations a second (forward and gradient, nothing computed twice) over those of the fastest large
        matrix product on all devices; None where that is not known.
    """

    frames_per_second: float
    data_share: float
    utilisation: float | None


class RunTimes:
    """Measures what one start of a run spends its time on.

    The loop calls `count` after each step and `read` when it logs and the last step has finished; it enters `waiting`
    to get a batch, and `other` for what is no step.

    Attributes:
      productive: seconds of the steps that made the present state, those of earlier starts too.
    """

    def __init__(
        self,
        config: TrainConfig,
        *,
        productive: float = 0.0,
        costs: Mapping[str, float] | None = None,
        peak: float | None = None,
    ) -> None:
        """Args: `costs` are those that an earlier start found, `peak` operations a second of all devices at their
        best."""
        self.productive = productive
        self._config, self._peak = config, peak
        self._earlier = dict(costs or {})
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
        """Time of a `compilation` of a stage, `validation`, `save` or another `kind`, in which no step runs."""
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
        speed = Speed(
            frames_per_second=frames / seconds,
            data_share=min(self._waited / seconds, 1.0),
            utilisation=self._operations / seconds / self._peak if self._peak and self._operations else None,
        )
        self.begin()
        return speed

    @property
    def costs(self) -> dict[str, float]:
        """Seconds that one of each kind of `other` takes: the mean since the start, else that of the start before."""
        return self._earlier | {kind: sum(seconds) / len(seconds) for kind, seconds in self._others.items()}

    def remaining_seconds(self, step: int, end: int | None = None) -> float:
        """Seconds until step `end` (None: the last of all), if frames, validations and saves take as long as so far.

        A stage that is still to begin is compiled first where its clips have a shape of their own.
        """
        config = self._config
        end = config.total_steps if end is None else end
        frames, begin, compilations = 0, 0, 0
        compiled: set[tuple[int, ...]] = set()
        saves = end // config.save_every - step // config.save_every
        for stage in config.stages:
            first, begin = begin, begin + stage.steps
            frames += _frames(stage) * max(min(begin, end) - max(first, step), 0)
            # The last step of a stage is saved whatever its number.
            saves += step < begin <= end and begin % config.save_every > 0
            compilations += step <= first < end and not stage.clip_shapes <= compiled
            # Of stages that were done before this start, whatever JAX's cache on the disk may hold, nothing is known.
            compiled |= stage.clip_shapes if begin > step else set()
        validations = 0
        if config.validation is not None:
            every = config.validation.every
            validations = end // every - step // every + (step < end == config.total_steps and end % every > 0)
        counts = {"save": saves, "validation": validations, "compilation": compilations}
        costs = self.costs
        return frames * (self._seconds_a_frame or 0.0) + sum(
            count * costs.get(kind, 0.0) for kind, count in counts.items()
        )


def _frames(stage: StageConfig) -> int:
    return stage.batch_size * stage.clip_length
