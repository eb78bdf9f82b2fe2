"""What configuration files may say, and how mistakes are named."""

from typing import Any

import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.protocols.clips import ClipSettings
from logvggt_jax.evaluation.settings import ClipRun, PaperRun, read_run
from logvggt_jax.streaming import ChunkPlan

CLIPS = {"image_size": [28, 42], "clip_lengths": [4]}
CLIP_RUN = {"title": "t", "dataset": "rooms", "split": "test", "baselines": False, "evaluation": CLIPS}
PAPER_RUN = {"title": "t", "benchmarks": ["*"], "baselines": True, "protocol": {"longer_edge": 70}}


def test_the_kind_of_a_run_follows_from_its_fields() -> None:
    clips, paper = read_run(CLIP_RUN), read_run(PAPER_RUN)
    assert isinstance(clips, ClipRun) and clips.evaluation == ClipSettings(image_size=(28, 42), clip_lengths=(4,))
    assert isinstance(paper, PaperRun) and paper.protocol.longer_edge == 70 and paper.benchmarks == ("*",)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"image_size": (56, 71)}, r"config\.evaluation\.image_size must be \(H, W\), multiples of 14"),
        ({"clip_lengths": ()}, r"config\.evaluation\.clip_lengths must be"),
        ({"clip_lengths": (1,)}, r"config\.evaluation\.clip_lengths must be"),
        ({"clip_lengths": (12, 4, 12)}, r"config\.evaluation\.clip_lengths must be different .* got \(12, 4, 12\)"),
        ({"stride": 0}, r"config\.evaluation\.stride must be a positive integer, got 0"),
        ({"stride": "2"}, r"config\.evaluation\.stride must be a whole number, got '2'"),
        ({"max_points": 0}, r"config\.evaluation\.max_points must be"),
        ({"seed": -1}, r"config\.evaluation\.seed must be an integer of at least 0, got -1"),
        ({"figures": -3}, r"config\.evaluation\.figures must be an integer of at least 0, got -3"),
        ({"icp_threshold": -1.0}, r"config\.evaluation\.icp_threshold must lie in \(0, inf\)"),
        ({"length": 4}, r"unknown field config\.evaluation\.length"),
    ],
)
def test_wrong_clips_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_run({**CLIP_RUN, "evaluation": {**CLIPS, **values}})


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("protocol", {"longer_edge": 71}, r"config\.protocol\.longer_edge must be a multiple of 14"),
        ("protocol", {"long_edge": 70}, r"unknown field config\.protocol\.long_edge"),
        ("protocol", {"max_points": 0}, r"config\.protocol\.max_points must be"),
        ("protocol", {"seed": -1}, r"config\.protocol\.seed must be an integer of at least 0, got -1"),
        ("figures", -1, r"config\.figures must be an integer of at least 0"),
        ("benchmarks", (), r"config\.benchmarks must name at least one"),
        ("max_sequences", 0, r"config\.max_sequences must be a positive integer"),
        ("methods", ("window",), r"config\.methods: unknown 'window'; known are windows, "),
        ("variants", ("full", "no_gcrc"), r"config\.variants: unknown 'no_gcrc'; known are full, no_gccr, "),
        ("settings", {"offlin": {}}, r"config\.settings: unknown 'offlin'; known are windows, "),
        ("settings", {"offline": {"max_frames": 0}}, r"config: settings\.offline\.max_frames must be"),
        ("settings", {"chunks": {"overlaps": 4}}, r"unknown field settings\.chunks\.overlaps; did you mean overlap\?"),
        ("settings", {"chunks": {"size": 4, "overlap": 4}}, "below the chunk size 4, got 4"),
        ("timings", {"lengths": (0,)}, r"config\.timings\.lengths must be different numbers of frames, 1 or more each"),
        ("timings", {"lengths": (5, 9, 5)}, r"config\.timings\.lengths must be different numbers"),
        ("timings", {"rounds": 0}, r"config\.timings\.rounds must be"),
        ("timings", {"length": (5,)}, r"unknown field config\.timings\.length"),
    ],
)
def test_wrong_settings_of_the_papers_run_are_named(field: str, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_run({**PAPER_RUN, field: value})


@pytest.mark.parametrize("run", [CLIP_RUN, PAPER_RUN])
def test_a_run_of_no_rows_is_refused(run: dict[str, Any]) -> None:
    nothing = {**run, "methods": (), "variants": (), "baselines": False}
    with pytest.raises(InputError, match=r"^config\.methods names none, .*: name one, or set baselines=True$"):
        read_run(nothing)
    for rows in ({"methods": ["windows"]}, {"variants": ["full"]}, {"baselines": True}):
        read_run({**nothing, **rows})


def test_settings_of_a_method_are_of_its_own_class() -> None:
    found = read_run({**CLIP_RUN, "methods": ["chunks", "windows"], "settings": {"chunks": {"size": 6, "overlap": 3}}})
    assert found.settings_of("chunks") == ChunkPlan(6, 3) and found.settings_of("windows") is None


def test_options_that_nobody_has_given_are_not_recorded() -> None:
    """A configuration file has a place for each option of a reader: None until the command line fills it."""
    options = {"num_rooms": 8, "laps": None}
    assert read_run({**CLIP_RUN, "options": options}).options == {"num_rooms": 8}
    paper = read_run({**PAPER_RUN, "protocol": {"options": {"rooms": options}}})
    assert paper.protocol.options == {"rooms": {"num_rooms": 8}}


def test_missing_and_unknown_fields_are_named() -> None:
    with pytest.raises(InputError, match=r"unknown field config\.data_set"):
        read_run({**CLIP_RUN, "data_set": "rooms"})
    with pytest.raises(InputError, match=r"missing field config\.evaluation, "):
        read_run({name: value for name, value in CLIP_RUN.items() if name != "evaluation"})
    with pytest.raises(InputError, match=r"missing field config\.evaluation\.clip_lengths"):
        read_run({**CLIP_RUN, "evaluation": {"image_size": (28, 42)}})
