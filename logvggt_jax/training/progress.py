"""Speed and remaining time of a run, and the line that says so."""

from __future__ import annotations

import time

from logvggt_jax.training.config import StageConfig


class Speedometer:
    """Frames a second since the last reading, without what `pause` leaves out (compiling, validating, saving)."""

    def __init__(self, stages: tuple[StageConfig, ...]) -> None:
        self._stages = stages
        self._steps, self._started = 0, time.perf_counter()
        self.step_seconds, self.frames_per_second = 0.0, 0.0

    def count(self) -> None:
        """One more step was taken."""
        self._steps += 1

    def restart(self) -> None:
        """Starts measuring anew."""
        self._steps, self._started = 0, time.perf_counter()

    def read(self, stage: StageConfig) -> None:
        """Measures the steps counted since the last reading or restart, all of them of `stage` and finished."""
        if self._steps:
            self.step_seconds = (time.perf_counter() - self._started) / self._steps
            self.frames_per_second = _frames(stage) / max(self.step_seconds, 1e-9)
        self.restart()

    def remaining_seconds(self, step: int) -> float:
        """Time that the steps after `step` need at the current number of frames a second."""
        frames, end = 0, 0
        for stage in self._stages:
            end += stage.steps
            frames += _frames(stage) * min(stage.steps, max(end - step, 0))
        return frames / max(self.frames_per_second, 1e-9)


def progress_line(step: int, total: int, stage: str, values: dict[str, float], speed: Speedometer) -> str:
    """What the terminal shows of a logging step."""
    return (
        f"step {step}/{total} {stage}: loss {values['loss/total']:.4f}, abs_rel {values['train/abs_rel']:.3f}, "
        f"rotation {values['train/rotation_over_identity']:.2f} of identity's, "
        f"direction {values['train/translation_direction']:.0f}°, {speed.frames_per_second:.0f} frames/s, "
        f"{duration(speed.remaining_seconds(step))} left"
    )


def duration(seconds: float) -> str:
    """Hours, minutes and seconds as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _frames(stage: StageConfig) -> int:
    return stage.batch_size * stage.clip_length
