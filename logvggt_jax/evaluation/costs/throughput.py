"""Frames a second of whole sequences, and their time by part: what the paper's tables of cost measure."""

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from logvggt_jax.config import require_counts
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.costs.parts import PARTS, live_device_bytes, sequence_parts, time_part
from logvggt_jax.evaluation.environment import code_version, describe_device
from logvggt_jax.evaluation.methods.method import Checkpoint, Method
from logvggt_jax.evaluation.methods.variants import VARIANTS, variant_methods
from logvggt_jax.evaluation.progress import progress_display
from logvggt_jax.evaluation.records import plain, record_key
from logvggt_jax.files import open_regular, write_text
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.streaming import PredictionError, Predictor

# Distinct pictures; a sequence shows them in turn.
NUM_PICTURES = 16
# Cameras of the paper's benchmarks are 4 : 3.
_ASPECT = 3 / 4
# Variants with GCCR once at the end and after every window, each with both trunks: the modes of the paper's tables.
_MODES = ("full", "gccr_online")


@dataclasses.dataclass(frozen=True)
class TimingConfig:
    """The sequences that are timed."""

    lengths: tuple[int, ...] = (100, 200, 500, 1000)  # frames of each; none of them times nothing
    rounds: int = 3  # times that each is run, after once that does not count

    def __post_init__(self) -> None:
        object.__setattr__(self, "lengths", tuple(sorted(self.lengths)))
        if any(n < 1 for n in self.lengths):
            raise InputError(f"TimingConfig.lengths must be numbers of frames, 1 or more each, got {self.lengths}")
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

    `output`/timings.json keeps them: an evaluation by the same code that goes on in the folder, on the same device,
    does not measure again.

    Args:
      checkpoint: the model; its mode of refinement is replaced by each of the paper's.
      references: other rows, by their predictors. A length that one of them cannot take has the reason in place of
        its rates.
      config: what is timed.
      output: folder of the evaluation.
      longer_edge: pixels; pictures are 4 : 3.
      fresh: measure again, whatever is there.

    Returns:
      JSON values: `device`, `dtype`, `image_size`, `windows`, `frames_per_second` (by row and length a list of rates,
      or the reason why there are none), `part_frames` and `parts` (`name`, `seconds`) with GCCR once at the end.
    """
    base = checkpoint.model.config
    image_size = (max(round(longer_edge * _ASPECT / 14), 1) * 14, longer_edge)
    setting = {
        "device": describe_device(),
        "dtype": base.dtype,
        "image_size": list(image_size),
        "windows": [base.windows.size, base.windows.stride],
        "lengths": list(config.lengths),
        "rounds": config.rounds,
    }
    rows = [*variant_methods(checkpoint, _MODES), *references]
    code = [code_version("evaluation/costs"), jax.__version__]
    key = record_key(code, setting, [[row.name, row.identity] for row in rows])
    if not fresh and (found := kept_timings(output)).get("key") == key:
        return found
    pictures = random_pictures(image_size)
    rates: dict[str, dict[str, Any]] = {row.name: {} for row in rows}
    with progress_display(None) as progress:
        task = progress.add_task("timing", total=len(rows) * len(config.lengths) + 1)
        for length in config.lengths:
            for row in rows:
                progress.update(task, description=f"timing: {row.name}, {length} frames")
                rates[row.name][str(length)] = _rates(row, pictures, length, config.rounds)
                progress.advance(task)
        progress.update(task, description="timing: parts")
        full = LogVGGT(VARIANTS["full"].config(base))
        parts = sequence_parts(full, config.lengths[-1], image_size)
        times = [time_part(part, checkpoint.variables, rounds=config.rounds) for part in parts]
        progress.advance(task)
    report = {
        "key": key,
        **setting,
        "frames_per_second": rates,
        "part_frames": config.lengths[-1],
        "parts": [
            {"name": name, "seconds": sum(t.calls * t.median for t in times if t.name == name)} for name in PARTS
        ],
    }
    keep_timings(output, report)
    return report


def _rates(row: Method, pictures: np.ndarray, length: int, rounds: int) -> list[float] | str:
    """Frames a second of each round but the first, or why there are none."""
    assert row.start is not None  # rows of the model have predictors
    try:
        runs = [time_stream(row.start(), pictures, length) for _ in range(rounds + 1)]
    except PredictionError as error:
        return str(error)
    return [length / run.seconds for run in runs[1:]]


def keep_timings(output: Path, report: Mapping[str, Any]) -> None:
    """Writes `output`/timings.json, for an evaluation that goes on."""
    output.mkdir(parents=True, exist_ok=True)
    write_text(output / "timings.json", json.dumps(plain(report), indent=1) + "\n")


def kept_timings(output: Path) -> dict[str, Any]:
    """What `keep_timings` wrote, or nothing."""
    try:
        with open_regular(output / "timings.json") as stream:
            found = json.loads(stream.read())
    except (OSError, ValueError, RecursionError):  # not there, or damaged: measured anew
        return {}
    return found if isinstance(found, dict) else {}
