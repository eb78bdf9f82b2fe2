"""Every method's frames a second, beside what the original PyTorch code reaches on one H100."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from logvggt_jax.doctor.finding import Finding
from logvggt_jax.doctor.subject import Subject, random_variables
from logvggt_jax.evaluation.costs.streams import random_pictures, time_stream, unlimited_settings
from logvggt_jax.model.logvggt import LogVGGT
from logvggt_jax.model.parameters import in_compute_type
from logvggt_jax.streaming import (
    METHODS,
    CausalSettings,
    PredictionError,
    RollingSettings,
    open_predictor,
)


class Original(NamedTuple):
    """Frames a second of an original on one H100 at 392 x 518 pixels.

    Attributes:
      name: of the method.
      rates: by number of frames: of a stream the rate when it has so many frames, of an offline method that of so many.
    """

    name: str
    rates: dict[int, float]


# A stream's rates are those of single frames, early and late; InfiniteVGGT's late one is that of a full cache, which it
# has from frame 48 on.
STREAMED = 83
ORIGINALS = {
    "causal": Original("StreamVGGT", {0: 10.9, STREAMED - 1: 5.0}),
    "rolling": Original("InfiniteVGGT", {0: 9.0, STREAMED - 1: 5.8}),
    "offline": Original("VGGT", {100: 25.5, 200: 14.9}),
}
# Frames over which a stream's early and late rates are taken.
_SPAN = 8


def examine(method: str, subject: Subject) -> Iterator[Finding]:
    """Frames a second of one method; a first stream compiles. Originals are compared on an accelerator alone."""
    subject = dataclasses.replace(subject, model=_with_a_view(subject.model))
    variables = jax.device_put(in_compute_type(random_variables(subject.model), subject.model.config))
    pictures = random_pictures(subject.image_size)
    measured = _in_batches if METHODS[method].in_batches else _streamed
    try:
        yield from measured(method, subject, variables, pictures)
    except PredictionError as error:
        # A smaller device than the originals': what was timed before counts.
        yield Finding(method, "more frames", None, note=str(error))


def _with_a_view(model: LogVGGT) -> LogVGGT:
    """Random parameters have no field of view worth the name, and chunks could not be aligned: poses start from one."""
    head = dataclasses.replace(model.config.camera_head, initial_pose=(0.0,) * 6 + (1.0,) * 3)
    return LogVGGT(dataclasses.replace(model.config, camera_head=head))


def _streamed(method: str, subject: Subject, variables: Any, pictures: np.ndarray) -> Iterator[Finding]:
    frames = 2 * _SPAN + 4 if subject.tiny else STREAMED
    settings: Any = None
    # Room from the start, so that one program serves all frames and nothing compiles while they are timed.
    if method == "causal":
        settings = CausalSettings(first_capacity=frames)
    if method == "rolling":
        settings = RollingSettings(first_capacity=2 * frames)

    def ends() -> list[float]:
        """When the stream began and when the results of each push were there, seconds."""
        predictor, found = open_predictor(method, subject.model, variables, settings), [time.perf_counter()]
        for index in range(frames):
            predictor.push(pictures[index % len(pictures)])
            found.append(time.perf_counter())
        predictor.close()
        return found

    first, seconds = ends(), ends()
    yield Finding(method, f"compilation, {frames} frames", first[-1] - first[0] - (seconds[-1] - seconds[0]), "s")
    # A push returns the results of the one before: the first ones only fill the pipeline.
    early = _SPAN / (seconds[2 + _SPAN] - seconds[2])
    late = _SPAN / (seconds[-1] - seconds[-1 - _SPAN])
    yield _rate(method, f"frames/s, frames 2 to {1 + _SPAN}", early, 0, subject)
    yield _rate(method, f"frames/s, frames {frames - _SPAN} to {frames - 1}", late, STREAMED - 1, subject)


def _in_batches(method: str, subject: Subject, variables: Any, pictures: np.ndarray) -> Iterator[Finding]:
    lengths = (6,) if subject.tiny else (100,) if subject.quick else (100, 200)
    settings = unlimited_settings(method)
    for count in lengths:

        def run(count: int = count) -> float:
            predictor = open_predictor(method, subject.model, variables, settings)
            return time_stream(predictor, pictures, count).seconds

        first = run()
        seconds = statistics.median(run() for _ in range(1 if subject.tiny else 3))
        yield Finding(method, f"compilation, {count} frames", first - seconds, "s")
        yield _rate(method, f"frames/s, {count} frames", count / seconds, count, subject)


def _rate(method: str, what: str, rate: float, frames: int, subject: Subject) -> Finding:
    """A rate with the original's beside it, where there is one; judged on the GPU on which that was measured."""
    original = ORIGINALS.get(method)
    if subject.tiny or original is None or frames not in original.rates:
        return Finding(method, what, rate, "frames/s")
    theirs = original.rates[frames]
    ok = rate > theirs if "H100" in jax.devices()[0].device_kind else None
    note = f"{rate / theirs:.2f} x the {theirs} of {original.name}'s PyTorch code on one H100"
    return Finding(method, what, rate, "frames/s", ok=ok, note=note)
