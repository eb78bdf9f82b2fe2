"""Frames a second of whole sequences, and their time by part: what the paper's tables of cost measure."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from logvggt_jax.config import ModelConfig, require_counts
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.costs.parts import PARTS, live_device_bytes, sequence_parts, time_part
from logvggt_jax.evaluation.environment import code_version, describe_device
from logvggt_jax.evaluation.methods.method import Checkpoint, Method, PredictionError
from logvggt_jax.evaluation.progress import progress_display
from logvggt_jax.evaluation.records import plain, record_key
from logvggt_jax.files import write_text
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.streaming import StreamSession

# Distinct pictures; a sequence shows them in turn.
NUM_PICTURES = 16
# Cameras of the paper's benchmarks are 4 : 3.
_ASPECT = 3 / 4
_TIMED_MODES = {
    "LoG-VGGT, full-sequence GCCR": "full",
    "LoG-VGGT, online GCCR": "online",
    "LoG-VGGT, online GCCR, trunk limited to K": "online+context",
}


@dataclasses.dataclass(frozen=True)
class TimingConfig:
    """The sequences that are timed.

    Attributes:
      lengths: frames of each; none of them times nothing.
      rounds: times that each is run, after once that does not count.
    """

    lengths: tuple[int, ...] = (100, 200, 500, 1000)
    rounds: int = 3

    def __post_init__(self) -> None:
        object.__setattr__(self, "lengths", tuple(sorted(self.lengths)))
        if any(n < 1 for n in self.lengths):
            raise InputError(f"TimingConfig.lengths must be numbers of frames, 1 or more each, got {self.lengths}")
        require_counts(self, "rounds")


@dataclasses.dataclass(frozen=True)
class StreamTime:
    """One stream: seconds in all, until the first result, of each step; most bytes of arrays alive between frames."""

    seconds: float
    first_result: float
    steps: list[float]
    live_bytes: int


def refinement_modes(base: ModelConfig, context: int) -> dict[str, ModelConfig]:
    """GCCR once at the end or after every window, with the camera head's trunk over all frames or over `context`."""

    def refined(period: int | None, context: int | None) -> ModelConfig:
        settings = dataclasses.replace(base.refinement, enabled=True, period=period, context=context)
        return dataclasses.replace(base, refinement=settings)

    return {
        "full": refined(None, None),
        "full+context": refined(None, context),
        "online": refined(base.windows.stride, None),
        "online+context": refined(base.windows.stride, context),
    }


def random_pictures(image_size: tuple[int, int]) -> np.ndarray:
    """[16, H, W, 3] uint8."""
    return np.random.default_rng(0).integers(0, 256, (NUM_PICTURES, *image_size, 3), np.uint8)


def time_stream(
    model: LogVGGT, variables: Any, pictures: np.ndarray, num_frames: int, *, watch: bool = False
) -> StreamTime:
    """Sends frames through a session: host pictures in, host depth out, cameras at the end.

    Args:
      model: its refinement decides what runs when.
      variables: {"params": …} on the device.
      pictures: [N, H, W, 3] uint8, shown in turn.
      num_frames: of the stream.
      watch: look at memory between frames, which takes time of its own.
    """
    session = StreamSession(model, variables)
    steps: list[float] = []
    first_result, live = 0.0, 0
    started = time.perf_counter()
    for index in range(num_frames):
        pushed = time.perf_counter()
        results = session.push(pictures[index % len(pictures)])
        if results:
            steps.append(time.perf_counter() - pushed)
            first_result = first_result or time.perf_counter() - started
        if watch:
            live = max(live, live_device_bytes())
    session.close()
    session.cameras()
    return StreamTime(time.perf_counter() - started, first_result, steps, live)


def measured_timings(
    checkpoint: Checkpoint,
    references: Sequence[Method],
    config: TimingConfig,
    output: Path,
    *,
    longer_edge: int,
    fresh: bool = False,
) -> dict[str, Any]:
    """Frames a second of the model and its references by length, and the time by part of the longest sequence.

    `output`/timings.json keeps them: an evaluation that goes on in the folder, on the same device, does not measure
    again.

    Args:
      checkpoint: the model; its mode of refinement is replaced by each of the paper's.
      references: other rows. A sequence that one of them cannot predict has the reason in place of its rates.
      config: what is timed.
      output: folder of the evaluation.
      longer_edge: pixels; pictures are 4 : 3.
      fresh: measure again, whatever is there.

    Returns:
      JSON values: `device`, `dtype`, `image_size`, `windows`, `frames_per_second` (by row and length a list of rates,
      or the reason why there are none), `part_frames` and `parts` (`name`, `seconds`) with GCCR once at the end.
    """
    model, variables = checkpoint.model, checkpoint.variables
    image_size = (max(round(longer_edge * _ASPECT / 14), 1) * 14, longer_edge)
    setting = {
        "device": describe_device(),
        "dtype": model.config.dtype,
        "image_size": list(image_size),
        "windows": [model.config.windows.size, model.config.windows.stride],
        "lengths": list(config.lengths),
        "rounds": config.rounds,
    }
    rows = [[reference.name, reference.identity] for reference in references]
    key = record_key(
        code_version("evaluation/costs"), setting, model.config.to_dict(), rows, checkpoint.digest, jax.__version__
    )
    kept = output / "timings.json"
    if not fresh and (found := _read(kept)).get("key") == key:
        return found
    pictures = random_pictures(image_size)
    modes = refinement_modes(model.config, model.config.windows.size)
    full = LogVGGT(modes["full"])
    rates: dict[str, dict[str, Any]] = {name: {} for name in [*_TIMED_MODES, *(r.name for r in references)]}
    with progress_display(None) as progress:
        task = progress.add_task("timing", total=len(rates) * len(config.lengths) + 1)
        for length in config.lengths:
            for name, mode in _TIMED_MODES.items():
                progress.update(task, description=f"timing: {name}, {length} frames")
                timed = LogVGGT(modes[mode])
                runs = [time_stream(timed, variables, pictures, length) for _ in range(config.rounds + 1)]
                rates[name][str(length)] = [length / run.seconds for run in runs[1:]]
                progress.advance(task)
            images = np.resize(pictures, (length, *pictures.shape[1:]))
            for reference in references:
                progress.update(task, description=f"timing: {reference.name}, {length} frames")
                rates[reference.name][str(length)] = _method_rates(reference, images, config.rounds)
                progress.advance(task)
        progress.update(task, description="timing: parts")
        times = [time_part(p, variables, rounds=config.rounds) for p in sequence_parts(full, length, image_size)]
        progress.advance(task)
    parts = [{"name": name, "seconds": sum(t.calls * t.median for t in times if t.name == name)} for name in PARTS]
    report = {"key": key, **setting, "frames_per_second": rates, "part_frames": config.lengths[-1], "parts": parts}
    write_text(kept, json.dumps(plain(report), indent=1) + "\n")
    return report


def _method_rates(method: Method, images: np.ndarray, rounds: int) -> list[float] | str:
    seconds = []
    for _ in range(rounds + 1):
        started = time.perf_counter()
        try:
            method.predict(images)
        except PredictionError as error:
            return str(error)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            return "out of memory on the device"
        seconds.append(time.perf_counter() - started)
    return [len(images) / each for each in seconds[1:]]


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):  # not there, or damaged: measured anew
        return {}
    return found if isinstance(found, dict) else {}
