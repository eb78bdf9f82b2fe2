"""The harness that damages inputs tells right outcomes from wrong ones; a small sample of its cases passes."""

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from fuzzing.cases import Kind, Nonsense, run_case
from fuzzing.damages import damage
from fuzzing.kinds import KINDS
from fuzzing.pool import run_cases

from logvggt_jax.errors import InputError
from logvggt_jax.files import open_regular

pytestmark = pytest.mark.usefixtures("forked_workers")

SAMPLED = ("result", "trajectory", "evaluation")


def write(root: Path) -> None:
    (root / "file.txt").write_text("1 2 3\n" * 20)


def read_well(root: Path, output: Path) -> None:
    with open_regular(root / "file.txt") as stream:
        if stream.read() != b"1 2 3\n" * 20:
            raise InputError(f"{root / 'file.txt'} is damaged")


def spoilt(root: Path) -> bool:
    """Whether this is a case, and not the valid input."""
    return root.name == "input"


def read_without_file(root: Path, output: Path) -> None:
    if spoilt(root):
        raise InputError("something is damaged")


def read_on_two_lines(root: Path, output: Path) -> None:
    if spoilt(root):
        raise InputError(f"{root}\nis damaged")


def read_with_a_bug(root: Path, output: Path) -> None:
    if spoilt(root):
        raise KeyError("a bug")


def read_nonsense(root: Path, output: Path) -> None:
    if spoilt(root):
        raise Nonsense("not finite")


def read_for_ever(root: Path, output: Path) -> None:
    while spoilt(root):
        time.sleep(0.1)


def read_and_die(root: Path, output: Path) -> None:
    if spoilt(root):
        os._exit(3)


def read_nothing(root: Path, output: Path) -> None:
    raise ValueError("never reads")


READERS = {
    "message": read_without_file,
    "two lines": read_on_two_lines,
    "exception": read_with_a_bug,
    "nonsense": read_nonsense,
    "hang": read_for_ever,
    "crash": read_and_die,
    "invalid": read_nothing,
}


def test_wrong_outcomes_are_told_from_right_ones_and_end_nothing(tmp_path: Path) -> None:
    kinds = [Kind("well", write, read_well), *(Kind(name, write, read) for name, read in READERS.items())]
    cases = [(kind.name, seed) for kind in kinds for seed in (1, 2)]
    keep = tmp_path / "kept"
    outcomes = list(run_cases(kinds, cases, tmp_path / "work", workers=2, limit=2.0, keep=keep))
    assert sorted((outcome.kind, outcome.seed) for outcome in outcomes) == sorted(cases)
    verdicts = {outcome.kind: outcome.verdict for outcome in outcomes}
    special = {"two lines": "message", "invalid": "exception", "well": verdicts["well"]}
    assert verdicts == {kind.name: special.get(kind.name, kind.name) for kind in kinds}
    assert {outcome.verdict for outcome in outcomes if outcome.kind == "well"} <= {"result", "line"}
    failed = {outcome.kind for outcome in outcomes if outcome.failed}
    assert failed == {*READERS}
    # What was done is known of all that came so far, and the damaged input of each is kept.
    assert all(outcome.damage for outcome in outcomes)
    assert {path.name for path in keep.iterdir()} == {f"{name}-{seed}" for name in READERS for seed in (1, 2)} - {
        "invalid-1",
        "invalid-2",
    }


def test_a_seed_makes_the_same_damage_again(tmp_path: Path) -> None:
    def spoil(folder: Path, seed: int) -> tuple[str, dict[str, bytes]]:
        folder.mkdir()
        write(folder)
        (folder / "table.json").write_text(json.dumps({"name": "x", "values": [1.5, 2.5]}))
        done = damage(folder, np.random.default_rng(seed))
        return done, {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}

    first = [spoil(tmp_path / f"first {seed}", seed) for seed in range(40)]
    assert first == [spoil(tmp_path / f"second {seed}", seed) for seed in range(40)]
    assert len({done for done, _ in first}) > 20


def test_a_case_leaves_nothing_behind(tmp_path: Path) -> None:
    valid = tmp_path / "valid"
    valid.mkdir()
    write(valid)
    for seed in range(30):
        assert not run_case(Kind("well", write, read_well), valid, tmp_path / "case", seed).failed
    assert [path.name for path in tmp_path.iterdir()] == ["valid"]
    read_well(valid, tmp_path)


def test_every_kind_has_a_name_of_its_own() -> None:
    names = [kind.name for kind in KINDS]
    assert len(set(names)) == len(names)  # of two with one name only one would be run


@pytest.mark.parametrize("name", SAMPLED)
def test_damaged_inputs_give_a_result_or_one_line_with_a_file(name: str, tmp_path: Path) -> None:
    kinds = [kind for kind in KINDS if kind.name == name]
    outcomes = list(run_cases(kinds, [(name, seed) for seed in range(60)], tmp_path, workers=1))
    assert [outcome for outcome in outcomes if outcome.failed] == []
    assert {outcome.verdict for outcome in outcomes} == {"result", "line"}
