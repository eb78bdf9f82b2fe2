"""The metrics file: one line a step, readable after a crash, continued without duplicates."""

import io
import math
import os
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event

from logvggt_jax.errors import DiskError
from logvggt_jax.training.reporting import metrics_log
from logvggt_jax.training.reporting.metrics_log import FILE_NAME, TIMES_NAME, MetricsLog, read_metrics


def _log(workdir: Path, first_step: int) -> MetricsLog:
    return MetricsLog(workdir, first_step=first_step, console=Console(quiet=True))


def test_lines_hold_what_was_written(tmp_path: Path) -> None:
    with _log(tmp_path, 0) as log:
        log.write(1, {"loss": 0.5, "bad": float("nan"), "rate": 0.25})
    (entry,) = read_metrics(tmp_path / FILE_NAME)
    assert entry["step"] == 1 and entry["loss"] == 0.5 and entry["bad"] is None
    (file,) = (tmp_path / "tensorboard").iterdir()
    drawn = [event for event in _events(file.read_bytes()) if event.step == 1 and event.HasField("summary")]
    assert {value.tag: value.simple_value for event in drawn for value in event.summary.value} == {
        "loss": 0.5,
        "rate": 0.25,
    }


def test_what_is_said_is_no_markup(tmp_path: Path) -> None:
    said = io.StringIO()
    with MetricsLog(tmp_path, first_step=0, console=Console(file=said)) as log:
        log.say("results in runs/sweep[3]/a[/b]")
    assert said.getvalue() == "results in runs/sweep[3]/a[/b]\n"


def test_pictures_are_shown_by_tensorboard(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    with _log(tmp_path, 0) as log:
        log.show(3, {"validation/rooms/clip": picture})
    (file,) = (tmp_path / "tensorboard").iterdir()
    found, events = {}, _events(file.read_bytes())
    assert events[0].file_version == "brain.Event:2"
    assert [event.step for event in events if event.HasField("session_log")] == [1], "where later ones take over"
    for event in events:
        found |= {value.tag: (event.step, value.image) for value in event.summary.value if value.HasField("image")}
    ((tag, (step, image)),) = found.items()
    assert (tag, step) == ("validation/rooms/clip", 3)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(image.encoded_image_string))), picture)


def _events(records: bytes) -> list[Event]:
    """Each is stored as its length, a check sum, itself, and another check sum."""
    events, place = [], 0
    while place < len(records):
        (length,) = struct.unpack_from("<Q", records, place)
        events.append(Event.FromString(records[place + 12 : place + 12 + length]))
        place += 12 + length + 4
    return events


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no disk that is always full")
@pytest.mark.parametrize("full", ["metrics", "events"])
def test_a_full_disk_is_one_line_and_keeps_nobody_waiting(tmp_path: Path, full: str) -> None:
    with pytest.raises(DiskError, match=r": No space left on device$"), _log(tmp_path, 0) as log:
        file = {"metrics": log._file, "events": log._events._records._writer}[full]
        disk = os.open("/dev/full", os.O_WRONLY)
        os.dup2(disk, file.fileno())
        os.close(disk)
        for step in range(1000):
            log.write(step, {"loss": 1.0})


def test_resumed_run_replaces_later_lines_and_an_unfinished_one(tmp_path: Path) -> None:
    with _log(tmp_path, 0) as log:
        for step in range(1, 6):
            log.write(step, {"loss": float(step)})
    with (tmp_path / FILE_NAME).open("a") as file:
        file.write('{"step": 6, "lo')
    with _log(tmp_path, 3) as log:
        log.write(4, {"loss": 40.0})
    entries = read_metrics(tmp_path / FILE_NAME)
    assert [(entry["step"], entry["loss"]) for entry in entries] == [(1, 1.0), (2, 2.0), (3, 3.0), (4, 40.0)]
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_run_that_begins_anew_replaces_step_0_and_keeps_when_it_began(tmp_path: Path) -> None:
    with _log(tmp_path, 0) as log:
        log.write(0, {"validation/abs_rel": 0.5})
    (earlier,) = (tmp_path / "tensorboard").iterdir()
    earlier.unlink()
    times = (tmp_path / TIMES_NAME).read_bytes()
    with MetricsLog(tmp_path, first_step=0, anew=True, console=Console(quiet=True)) as log:
        log.write(0, {"validation/abs_rel": 0.25})
    assert [entry["validation/abs_rel"] for entry in read_metrics(tmp_path / FILE_NAME)] == [0.25]
    assert (tmp_path / TIMES_NAME).read_bytes() == times
    (file,) = (tmp_path / "tensorboard").iterdir()
    begun = [event.step for event in _events(file.read_bytes()) if event.HasField("session_log")]
    assert begun == [0], "where it takes over from the start before"


def test_a_session_that_goes_on_knows_what_validations_and_saves_took(tmp_path: Path) -> None:
    with _log(tmp_path, 0) as log:
        assert not log.costs
        log.write_times(1, {"productive_seconds": 9.0, "seconds_of/save": 7.0, "seconds_of/validation": math.nan})
        log.write_times(2, {"productive_seconds": 18.0, "seconds_of/save": 8.0})
    with _log(tmp_path, 1) as log:
        assert log.costs == {"save": 7.0}, "of the step that it goes on from; what is not known is left out"


@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_the_time_since_the_first_start_is_not_known_once_the_clock_jumped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump: float
) -> None:
    day, steady = [1e9], [50.0]
    monkeypatch.setattr(time, "time", lambda: day[0])
    monkeypatch.setattr(metrics_log, "_steady_time", lambda: steady[0])

    def pass_by(seconds: float) -> None:
        day[0], steady[0] = day[0] + seconds, steady[0] + seconds

    with _log(tmp_path, 0) as log:
        pass_by(100.0)
        log.write_times(1, {"productive_seconds": 90.0})
        assert log.seconds_since_start() == 100.0
    # What passes between two sessions counts, though the steady clock begins anew where the machine does.
    day[0], steady[0] = day[0] + 1000.0, 3.0
    with _log(tmp_path, 1) as log:
        pass_by(100.0)
        assert log.seconds_since_start() == 1200.0
        day[0] += jump
        assert log.seconds_since_start() is None
        log.write_times(2, {"productive_seconds": 180.0})
    assert [entry.get("clock_set_by") for entry in read_metrics(tmp_path / TIMES_NAME)] == [None, None, jump]
    # Nor where the line that said so is of a step that was lost, once and again.
    for first in (2, 1, 1):
        with _log(tmp_path, first) as log:
            assert log.seconds_since_start() is None


def test_damaged_lines_cost_a_resumed_run_no_others(tmp_path: Path) -> None:
    with _log(tmp_path, 0) as log:
        for step in range(1, 4):
            log.write(step, {"loss": float(step)})
    lines = (tmp_path / FILE_NAME).read_bytes().splitlines()
    damaged = [lines[0], b"\xff\x00", b"7", b'{"loss": 1.0}', *lines[1:]]
    (tmp_path / FILE_NAME).write_bytes(b"\n".join([*damaged, b""]))
    (tmp_path / TIMES_NAME).write_text('{"step": 0}\n')
    with _log(tmp_path, 3) as log:
        assert log.productive_seconds == 0.0
        log.write(4, {"loss": 4.0})
    assert [entry["step"] for entry in read_metrics(tmp_path / FILE_NAME)] == [1, 2, 3, 4]
    assert (tmp_path / FILE_NAME).read_bytes().splitlines()[:3] == lines
