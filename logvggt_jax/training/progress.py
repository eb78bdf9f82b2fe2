"""How fast a run trains, how long it will still take, and the line that the terminal shows of it."""

import time

from logvggt_jax.training.config import StageConfig


class Speedometer:
    """Measures how many frames a second the run trains on.

    The loop calls `count` after each step and `read` when it logs. After compiling, validating or saving it calls
    `restart`, so that this time is not taken for training.

    Attributes:
      step_seconds: mean time of a step at the last reading.
      frames_per_second: frames trained on in a second at the last reading, 0 before the first.
    """

    def __init__(self, stages: tuple[StageConfig, ...]) -> None:
        self._stages = stages
        self._steps, self._started = 0, time.perf_counter()
        self.step_seconds, self.frames_per_second = 0.0, 0.0

    def count(self) -> None:
        """Notes that one more step was started."""
        self._steps += 1

    def restart(self) -> None:
        """Forgets the steps counted so far and starts the clock again."""
        self._steps, self._started = 0, time.perf_counter()

    def read(self, stage: StageConfig) -> None:
        """Updates both attributes from the steps since the last reading or restart, then restarts.

        Those steps must all belong to `stage`, and the last of them must have finished.
        """
        if self._steps:
            self.step_seconds = (time.perf_counter() - self._started) / self._steps
            self.frames_per_second = _frames(stage) / max(self.step_seconds, 1e-9)
        self.restart()

    def remaining_seconds(self, step: int) -> float:
        """Seconds until the end of the last stage, if the frames of all steps after `step` take as long as now."""
        frames, end = 0, 0
        for stage in self._stages:
            end += stage.steps
            frames += _frames(stage) * min(stage.steps, max(end - step, 0))
        return frames / max(self.frames_per_second, 1e-9)


def progress_line(step: int, total: int, stage: str, values: dict[str, float], speed: Speedometer) -> str:
    """One line about a step: loss, errors of this batch, speed and remaining time; `values` as they are logged."""
    return (
        f"step {step}/{total} {stage}: loss {values['loss/total']:.4f}, abs_rel {values['train/abs_rel']:.3f}, "
        f"rotation {values['train/rotation_over_identity']:.2f} of identity's, "
        f"direction {values['train/translation_direction']:.0f}°, {speed.frames_per_second:.0f} frames/s, "
        f"{duration(speed.remaining_seconds(step))} left"
    )


def duration(seconds: float) -> str:
    """Seconds as hours, minutes and seconds, 1:02:03, or as minutes and seconds, 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _frames(stage: StageConfig) -> int:
    return stage.batch_size * stage.clip_length
