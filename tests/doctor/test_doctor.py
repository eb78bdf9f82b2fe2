"""The doctor's parts on this CPU with the tiny model, and what it says of machines that are not as they should be."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from logvggt_jax.cli import main
from logvggt_jax.doctor import environment, examination, parity
from logvggt_jax.doctor.finding import Finding


@pytest.mark.parametrize("part", [part for part in examination.LIMITS if part != "environment"])
def test_every_part_finds_a_cpu_sound(part: str) -> None:
    findings = list(examination.part_findings(part, tiny=True, quick=True))
    assert {finding.part for finding in findings} == {part}
    assert not [finding for finding in findings if finding.ok is False]
    assert [finding for finding in findings if isinstance(finding.value, float) and finding.value > 0]
    names = {finding.what for finding in findings}
    wanted = {
        "parity": {"depth, float32", "pose_encodings, bfloat16"},
        "inference": {"step, back to back", "utilisation", "temporaries"},
        "training": {"1 clips of 3 frames: step", "1 clips of 3 frames: utilisation", "1 clips of 3 frames: loss"},
        "whole": {"rate, files to files", "processor time a frame"},
    }
    assert wanted[part] <= names


def test_a_machine_that_computes_otherwise_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    right = parity.outputs("float32")
    wrong = {name: value * (1.001 if name == "depth" else 1.0) for name, value in right.items()}
    monkeypatch.setattr(parity, "outputs", lambda dtype: wrong)
    judged = {finding.what: finding.ok for finding in parity.examine()}
    assert not judged["depth, float32"]
    assert judged["pose_encodings, float32"]


def test_the_command_runs_parts_in_processes_of_their_own(capfd: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor", "--part", "environment", "--json"])
    findings = [Finding(**json.loads(line)) for line in capfd.readouterr().out.splitlines()]
    assert [finding.what for finding in findings if finding.what in ("Python", "jax", "devices", "time")] == [
        "Python", "jax", "devices", "time",
    ]  # fmt: skip
    assert code == int(any(finding.ok is False for finding in findings))


def test_a_part_that_fails_or_takes_too_long_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def popen(command: list[str], **options: object) -> subprocess.Popen:
        program = {"parity": "raise SystemExit('no luck')", "whole": "import time; time.sleep(60)"}
        return real([sys.executable, "-c", program[command[5]]], **options)  # type: ignore[call-overload]

    real = subprocess.Popen
    monkeypatch.setattr(examination.subprocess, "Popen", popen)
    monkeypatch.setattr(examination, "LIMITS", {"parity": (30, 30), "whole": (1, 1)})
    shown: list[Finding] = []
    examination.examine(["parity", "whole"], tiny=True, quick=True, show=shown.append)
    failed = {finding.part: finding.note for finding in shown if finding.ok is False}
    assert failed == {"parity": "no luck", "whole": "stopped after its limit of 1 s"}


def test_builds_side_by_side_and_idle_gpus_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["jax", "nvidia-nccl-cu12", "nvidia-nccl-cu13", "nvidia-cudnn-cu13"]
    installed = [SimpleNamespace(metadata={"Name": name}, version="1") for name in names]
    monkeypatch.setattr(importlib.metadata, "distributions", lambda: installed)
    monkeypatch.setattr(environment, "nvidia_gpu_present", lambda: True)
    wrong = {finding.what: finding for finding in environment.examine() if finding.ok is False}
    assert wrong["builds of nvidia-nccl-cu*"].value == "nvidia-nccl-cu12, nvidia-nccl-cu13"
    assert "builds of nvidia-cudnn-cu*" not in wrong
    assert "logvggt-jax[cuda]" in wrong["NVIDIA GPU"].note
    assert wrong["flax"].value_text() == "-"


def test_a_back_end_that_does_not_start_is_one_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise RuntimeError("Unable to initialize backend 'cuda':\ndriver too old")

    monkeypatch.setattr(jax, "devices", refuse)
    last = list(environment.examine())[-1]
    assert (last.what, last.ok) == ("devices", False)
    assert "driver too old" in last.note


def test_recorded_values_are_small_and_finite() -> None:
    assert all(np.isfinite(value).all() for value in parity.outputs("float32").values())


def test_an_unknown_part_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--part", "brain"]) == 2
    assert "no part 'brain'; it has environment" in capsys.readouterr().err
