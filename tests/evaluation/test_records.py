"""What a later run takes over from an earlier one in the same folder, and what it leaves alone."""

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_answers import SETTINGS, benchmarks_of, failing, run
from layouts import co3dv2, seven_scenes

from logvggt_jax.data.readers.co3dv2 import Co3Dv2
from logvggt_jax.data.readers.seven_scenes import SevenScenes
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation import environment, plan, runner
from logvggt_jax.evaluation.environment import code_version
from logvggt_jax.evaluation.methods.baselines import static_camera
from logvggt_jax.evaluation.plan import Benchmark
from logvggt_jax.streaming import PredictionError


def records(folder: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (folder / "clips.jsonl").read_text().splitlines()]
    return [line for line in lines if "key" in line]


def test_a_killed_evaluation_goes_on_where_it_stopped(rooms: Rooms, tmp_path: Path) -> None:
    whole = run(rooms, [static_camera()], tmp_path / "whole")
    method, calls = failing("killed", at_call=3)
    with pytest.raises(RuntimeError, match="killed"):
        run(rooms, [method], tmp_path / "killed")
    lines = tmp_path / "killed" / "clips.jsonl"
    assert len(lines.read_text().splitlines()) == 1 + 2
    # What a kill in the middle of a write leaves behind.
    with lines.open("a") as file:
        file.write('{"key": "half')
    with pytest.warns(UserWarning, match=r"clips\.jsonl: line 4 is cut off or damaged"):
        resumed = run(rooms, [method], tmp_path / "killed")
    assert len(calls) == 3 + 2, "two of four clips were left, and the third call had failed"
    assert resumed["summary"] == whole["summary"]
    again = run(rooms, [method], tmp_path / "killed")
    assert len(calls) == 5 and again["summary"] == whole["summary"]
    for name in ("whole", "killed"):
        assert len(records(tmp_path / name)) == 4


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: line[:5] + b"\xff" + line[6:],
        lambda line: line[:-9],
        lambda line: b"\0" * len(line),
        lambda line: b"7",
        lambda line: b"[" * 100_000,
        # Another number, another key and another field are as good JSON as before.
        lambda line: line.replace(b'"frames_used": 4', b'"frames_used": 5'),
        lambda line: re.sub(rb'"key": "..', b'"key": "zz', line),
        lambda line: line.replace(b'"digest"', b'"dagest"'),
        lambda line: line.replace(b'"metrics"', b'"matrics"'),
    ],
)
def test_damaged_lines_are_left_out_and_the_others_count(
    rooms: Rooms, tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    method, calls = failing("", at_call=-1)
    whole = run(rooms, [method], tmp_path)
    file = tmp_path / "clips.jsonl"
    lines = file.read_bytes().splitlines()
    place = next(number for number, line in enumerate(lines) if b'"frames_used": 4' in line)
    lines[place] = damage(lines[place])
    file.write_bytes(b"\n".join(lines) + b"\n")
    with pytest.warns(UserWarning, match=rf"{tmp_path}/clips\.jsonl: line {place + 1} is cut off or damaged"):
        again = run(rooms, [method], tmp_path)
    assert len(calls) == 4 + 1 and again["summary"] == whole["summary"] and len(records(tmp_path)) == 4


def test_records_of_before_they_had_digests_count(rooms: Rooms, tmp_path: Path) -> None:
    method, calls = failing("", at_call=-1)
    run(rooms, [method], tmp_path)
    file = tmp_path / "clips.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    for line in lines:
        line.pop("digest", None)
    lines[-1]["figures"] = ["figures/../../secret.png"]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.warns(UserWarning, match=r"line 5 is cut off or damaged"):
        run(rooms, [method], tmp_path)
    assert len(calls) == 4 + 1


def test_records_that_cannot_be_read_are_named(rooms: Rooms, tmp_path: Path) -> None:
    (tmp_path / "clips.jsonl").mkdir()
    with pytest.raises(InputError, match=r"clips\.jsonl is no file"):
        run(rooms, [static_camera()], tmp_path)


def test_results_of_other_settings_or_parameters_are_not_taken_over(rooms: Rooms, tmp_path: Path) -> None:
    method, calls = failing("", at_call=-1)
    for identity in ("a", "b"):
        run(rooms, [dataclasses.replace(method, identity=identity)], tmp_path)
    assert len(calls) == 8
    run(rooms, [dataclasses.replace(method, identity="b")], tmp_path, dataclasses.replace(SETTINGS, seed=1))
    assert len(calls) == 12 and len(records(tmp_path)) == 4


def test_a_sequence_whose_frames_differ_by_split_is_measured_again(tmp_path: Path) -> None:
    """A list of Co3Dv2 names frames; under the same name and indices `all` and `test` have other ones."""
    root = tmp_path / "co3dv2"
    co3dv2.LAYOUT.write(root, co3dv2.LAYOUT.views)
    sequence = co3dv2.NAME.split("/")[1]
    numbers = co3dv2.FRAME_NUMBERS[1:]
    co3dv2.write_list(root, "apple", "fewview_dev", test=[[sequence, number, "x"] for number in numbers])
    method, calls = failing("", at_call=-1)
    settings = dataclasses.replace(SETTINGS, clip_lengths=(2,), stride=1)
    for split, expected in (("all", 1), ("test", 2), ("test", 2)):
        run(Co3Dv2(root, split), [method], tmp_path / "out", settings)
        assert len(calls) == expected, split


def test_a_data_set_whose_truth_was_corrected_is_measured_again(tmp_path: Path) -> None:
    seven_scenes.LAYOUT.write(tmp_path / "set", seven_scenes.LAYOUT.views)
    method, calls = failing("", at_call=-1)
    settings = dataclasses.replace(SETTINGS, clip_lengths=(2,), stride=1)
    first = run(SevenScenes(tmp_path / "set"), [method], tmp_path / "out", settings)
    run(SevenScenes(tmp_path / "set"), [method], tmp_path / "out", settings)
    assert len(calls) == 1
    pose = next((tmp_path / "set").rglob("*000001.pose.txt"))
    np.savetxt(pose, np.eye(4))
    corrected = run(SevenScenes(tmp_path / "set"), [method], tmp_path / "out", settings)
    assert len(calls) == 2 and corrected["summary"] != first["summary"]
    # Elsewhere it is the same.
    (tmp_path / "set").rename(tmp_path / "moved")
    run(SevenScenes(tmp_path / "moved"), [method], tmp_path / "out", settings)
    assert len(calls) == 2


def test_pictures_of_a_sequence_with_a_long_name_are_drawn(tmp_path: Path) -> None:
    seven_scenes.LAYOUT.write(tmp_path / "set", seven_scenes.LAYOUT.views)
    (scene,) = (tmp_path / "set").iterdir()
    scene.rename(scene.with_name(120 * "ü"))
    settings = dataclasses.replace(SETTINGS, clip_lengths=(2,), stride=1, figures=1)
    results = run(SevenScenes(tmp_path / "set"), [static_camera()], tmp_path / "out", settings)
    assert results["figures"] and all((tmp_path / "out" / picture).is_file() for picture in results["figures"])


def test_rooms_measured_among_fewer_are_taken_over_by_a_run_over_more(tmp_path: Path) -> None:
    method, calls = failing("", at_call=-1)
    for num_rooms, expected in ((1, 2), (2, 4)):
        run(Rooms("test", height=28, width=42, num_frames=16, num_rooms=num_rooms), [method], tmp_path)
        assert len(calls) == expected


def test_other_code_measures_again(rooms: Rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    method, calls = failing("", at_call=-1)
    run(rooms, [method], tmp_path)
    monkeypatch.setattr(plan, "code_version", lambda: "other")
    run(rooms, [method], tmp_path)
    assert len(calls) == 8


def test_the_prose_of_a_protocol_measures_nothing_again(
    rooms: Rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method, calls = failing("", at_call=-1)
    run(rooms, [method], tmp_path)
    reworded = [
        Benchmark(dataclasses.replace(b.protocol, title="new title", decisions=("Reworded.",)), b.dataset, b.split)
        for b in benchmarks_of(rooms)
    ]
    monkeypatch.setattr("known_answers.benchmarks_of", lambda *_: reworded)
    results = run(rooms, [method], tmp_path)
    assert len(calls) == 4 and results["benchmarks"][0]["title"] == "new title"


def test_a_fresh_run_measures_all_again(rooms: Rooms, tmp_path: Path) -> None:
    method, calls = failing("", at_call=-1)
    for fresh in (False, True):
        run(rooms, [method], tmp_path, fresh=fresh)
    assert len(calls) == 8 and len(records(tmp_path)) == 4


def test_the_version_of_the_code_is_that_of_its_statements(tmp_path: Path) -> None:
    """Of the parts that decide numbers, and not of their comments and docstrings."""

    def version(name: str, text: str) -> str:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
        code_version.cache_clear()
        return code_version(package=tmp_path)

    for name in environment._DECIDING:
        assert (environment._PACKAGE / name).exists()
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch() if name.endswith(".py") else (tmp_path / name).mkdir(exist_ok=True)
    first = version("model/layers.py", 'def f(x):\n    """Doubles."""\n    return 2 * x\n')
    assert first == version("model/layers.py", 'def f(x):\n    """Twice x."""\n    # so\n    return 2 * x\n')
    assert first == version("evaluation/report/tables.py", "x = 1\n")
    assert first != version("model/layers.py", 'def f(x):\n    """Doubles."""\n    return 3 * x\n')
    before = version("data/packed/records.py", "def read(x):\n    return x\n")
    assert before != version("data/packed/records.py", "def read(x):\n    return -x\n"), "data may be packed"
    code_version.cache_clear()


def test_other_results_stay_until_the_new_ones_are_complete(rooms: Rooms, tmp_path: Path) -> None:
    drawn = dataclasses.replace(SETTINGS, figures=1)
    old, _ = failing("", at_call=-1)
    run(rooms, [old], tmp_path, drawn)
    figures = tmp_path / "figures"
    old_pictures = {f"figures/{path.name}": path.read_bytes() for path in figures.iterdir()}
    assert old_pictures
    theirs = [tmp_path / "report.md", tmp_path / "results.json", figures / "a_room_from_0_9_frames_depth.png"]
    for path in (theirs[0], theirs[2], tmp_path / "notes.txt", figures / "mine.png"):
        path.write_text("old")
    before, measured = theirs[1].read_text(), records(tmp_path)
    new, _ = failing("killed", at_call=3)
    new = dataclasses.replace(new, identity="new")
    with pytest.raises(RuntimeError, match="killed"):
        run(rooms, [new], tmp_path, drawn)
    assert theirs[1].read_text() == before and theirs[0].exists() and theirs[2].exists()
    assert records(tmp_path)[:4] == measured and len(records(tmp_path)) == 4 + 2
    # Those of the same clip by another method or model beside them, under other names.
    pictures = {
        picture: (tmp_path / picture).read_bytes() for record in measured for picture in record["figures"] or ()
    }
    assert pictures == old_pictures
    run(rooms, [new], tmp_path, drawn)
    assert len(records(tmp_path)) == 4
    assert not any((tmp_path / picture).exists() for picture in old_pictures)
    assert theirs[1].read_text() != "old" and not theirs[0].exists() and not theirs[2].exists()
    assert (tmp_path / "notes.txt").exists() and (figures / "mine.png").exists()


def test_results_name_the_environments_that_measured_them(
    rooms: Rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for device, methods in (("first", 1), ("second", 2), ("third", 2)):
        monkeypatch.setattr(runner, "environment", lambda device=device: {"device": device})
        rows = [static_camera(), dataclasses.replace(static_camera(), name="another")]
        results = run(rooms, rows[:methods], tmp_path)
    assert [each["device"] for each in results["environments"]] == ["first", "second"]


def test_pictures_that_are_missing_are_drawn_at_a_second_start(rooms: Rooms, tmp_path: Path) -> None:
    """Of the clips that are drawn alone, by the first method alone; a failure then costs no number."""
    first, calls = failing("no memory", at_call=9, error=PredictionError)
    second, others = failing("", at_call=-1)
    methods = [first, dataclasses.replace(second, name="second")]
    run(rooms, methods, tmp_path)
    assert (len(calls), len(others)) == (4, 4) and not list(tmp_path.rglob("*.png"))
    drawing = dataclasses.replace(SETTINGS, figures=1)

    def draw() -> dict[str, Any]:
        return run(rooms, methods, tmp_path, drawing)

    results = draw()
    assert (len(calls), len(others)) == (6, 4), "one clip of each length"
    pictures = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png")}
    assert pictures == set(results["figures"]) and len(pictures) == 2
    draw()
    assert len(calls) == 6
    (tmp_path / min(pictures)).unlink()
    assert draw()["figures"] == results["figures"] and len(calls) == 7 and (tmp_path / min(pictures)).exists()
    # The ninth call fails, and what was measured before stays.
    for name in pictures:
        (tmp_path / name).unlink()
    assert draw()["summary"] == results["summary"] and len(calls) == 9 and len(records(tmp_path)) == 8
