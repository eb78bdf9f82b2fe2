"""The time that is left counts what is no step; means are of the steps between two lines."""

import dataclasses
import io
import math
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from logvggt_jax.training.config import SourceConfig, TrainConfig, ValidationConfig
from logvggt_jax.training.reporting import intervals, progress
from logvggt_jax.training.reporting.metrics_log import FILE_NAME, TIMES_NAME, MetricsLog, read_metrics
from logvggt_jax.training.reporting.progress import IntervalMeans, progress_line
from logvggt_jax.training.reporting.run_times import RunTimes, Speed


class Clock:
    """A clock that goes on when it is told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    return clock


@pytest.fixture
def config(run_config: TrainConfig) -> TrainConfig:
    """A hundred steps of four frames, sixty of six; saves at 30, 60, …, 150, and at the ends of the stages."""
    source = SourceConfig(name="rooms", root=None, split="val")
    validation = ValidationConfig(sources=(source,), every=70, num_clips=2, clip_length=2, stride=1, size=(28, 42))
    first, second = run_config.stages
    stages = dataclasses.replace(first, steps=100), dataclasses.replace(second, steps=60)
    return dataclasses.replace(run_config, stages=stages, validation=validation, save_every=30)


def test_the_time_left_counts_validations_saves_and_compilations(config: TrainConfig, clock: Clock) -> None:
    times = RunTimes(config)
    for kind, seconds in {"compilation": 50.0, "save": 7.0, "validation": 20.0}.items():
        with times.other(kind):
            clock.now += seconds
    for _ in range(20):
        with times.waiting():
            clock.now += 1.0
        times.count()
        clock.now += 3.0
    speed = times.read(config.stages[0])
    assert speed == Speed(frames_per_second=1.0, data_share=0.25, utilisation=None)
    assert times.productive == 60.0
    # 80 steps; saves at 30, 60, 90 and 100; one validation at 70.
    assert times.remaining_seconds(20, 100) == 80 * 4 + 4 * 7 + 20
    # Besides 60 steps of six frames, whose program is still to be compiled; saves at 120, 150 and 160; validations at
    # 140 and 160.
    assert times.remaining_seconds(20) == 80 * 4 + 60 * 6 + (4 + 3) * 7 + 3 * 20 + 50
    assert times.remaining_seconds(100) == 60 * 6 + 3 * 7 + 2 * 20 + 50
    assert times.remaining_seconds(101) == 59 * 6 + 3 * 7 + 2 * 20
    assert times.remaining_seconds(160) == 0


def test_a_stage_of_shapes_that_are_there_is_not_compiled_again(config: TrainConfig, clock: Clock) -> None:
    first = config.stages[0]
    again = dataclasses.replace(first, name="again", steps=60)
    times = RunTimes(dataclasses.replace(config, stages=(first, again)), costs={"compilation": 50.0})
    assert times.remaining_seconds(20) == 0.0
    larger = dataclasses.replace(again, sizes=((28, 28), *first.sizes))
    times = RunTimes(dataclasses.replace(config, stages=(first, larger)), costs={"compilation": 50.0})
    assert times.remaining_seconds(20) == 50.0


def test_a_start_that_goes_on_counts_what_the_one_before_found(config: TrainConfig, clock: Clock) -> None:
    times = RunTimes(config, costs={"save": 7.0, "validation": 20.0})
    assert times.remaining_seconds(90, 100) == 7.0
    with times.other("save"):
        clock.now += 5.0
    assert times.costs == {"save": 5.0, "validation": 20.0}
    # Saves at 120, 150 and 160; validations at 140 and 160.
    assert times.remaining_seconds(100) == 3 * 5 + 2 * 20


@pytest.mark.parametrize("kind", ["save", "validation"])
def test_every_save_and_every_validation_counts(kind: str, config: TrainConfig, clock: Clock) -> None:
    times = RunTimes(config, costs={kind: 200.0})
    for seconds in (3.0, 5.0):
        with times.other(kind):
            clock.now += seconds
    assert times.costs == {kind: 4.0}


def test_utilisation_is_of_the_peak_in_the_time_of_steps(config: TrainConfig, clock: Clock) -> None:
    times = RunTimes(config, peak=100.0)
    for _ in range(4):
        times.count(operations=50.0)
        clock.now += 2.0
    with times.other("save"):
        clock.now += 1000.0
    assert times.read(config.stages[0]).utilisation == pytest.approx(0.25)


def test_means_are_of_finite_values_and_counters_are_the_last() -> None:
    means = IntervalMeans()
    for step, loss in enumerate([1.0, math.nan, 3.0]):
        means.add({"loss/total": loss, "learning_rate": float(step), "skipped": float(step), "longest_skip": 1.0})
    assert means.read() == {"loss/total": 2.0, "learning_rate": 2.0, "skipped": 2.0, "longest_skip": 1.0}
    means.add({"loss/total": math.nan})
    assert math.isnan(means.read()["loss/total"])


def test_a_line_tells_of_all_processes(config: TrainConfig, clock: Clock, tmp_path: Path) -> None:
    times = RunTimes(config)
    times.count()
    with times.waiting():
        clock.now += 1.0
    clock.now += 3.0
    shown = io.StringIO()
    values = {"loss/total": 1.0, "train/abs_rel": 0.1, "train/rotation_over_identity": 0.9, "learning_rate": 3e-4}
    values |= {"train/translation_direction": 50.0}
    options = {"config": config, "stage": config.stages[0], "end": 100}
    speed = times.read(config.stages[0])
    facts = [intervals.own_facts(speed, broken_clips=1, memory=2**30)]
    for share, broken, memory in ((0.5, 2, 3 * 2**30), (0.0, 0, None)):
        facts.append(intervals.own_facts(speed._replace(data_share=share), broken_clips=broken, memory=memory))
    with MetricsLog(tmp_path, first_step=0, console=Console(file=shown, width=1000)) as log:
        intervals.report_interval(log, 1, values, times, speed, np.stack(facts), **options)
    assert "waiting for data 50% (process 1), memory 3.0 GiB" in shown.getvalue()
    assert read_metrics(tmp_path / FILE_NAME)[-1]["broken_clips"] == 3.0
    assert read_metrics(tmp_path / TIMES_NAME)[-1]["data_share"] == 0.5
    assert times.productive == 3.0, "its own"


def test_goodput_is_not_known_where_the_clock_was_set() -> None:
    assert progress.goodput(60, 120) == "goodput 50%: 1:00 of training in 2:00 since the first start"
    for wall in (59.0, -3600.0):
        assert progress.goodput(60, wall).startswith("goodput not known, 1:00 of training in less time: the clock was")
    assert progress.goodput(60, None) == "goodput not known, 1:00 of training: the clock was set since the first start"


def test_a_line_says_what_a_person_looks_for() -> None:
    values = {"loss/total": 1.5, "loss/camera": 0.5, "loss/depth": 1.0, "learning_rate": 3e-4}
    values |= {"train/abs_rel": 0.1, "train/rotation_over_identity": 0.9, "train/translation_direction": 50.0}
    speed = Speed(frames_per_second=19.0, data_share=0.02, utilisation=0.29)
    line = progress_line(50, 100, "one", values, speed, memory=3 * 2**30, stage_seconds=61, run_seconds=3600)
    assert line == (
        "step 50/100 one: loss 1.5000 (camera 0.5, depth 1), abs_rel 0.100, rotation 0.90 of identity's, "
        "direction 50°, rate 3.00e-04, 19 frames/s, utilisation 0.29, waiting for data 2%, memory 3.0 GiB, "
        "1:01 left of the stage, 1:00:00 of the run"
    )
    assert progress.duration(59.6) == "1:00"
