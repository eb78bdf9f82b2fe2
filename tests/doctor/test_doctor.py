"""The doctor's parts on this CPU with the tiny model, and what it says of machines that are not as they should be."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig, Predictions
from logvggt_jax.cli import main
from logvggt_jax.cli.choices import METHOD_NAMES
from logvggt_jax.doctor import environment, examination, methods, parity, precision, training
from logvggt_jax.doctor.finding import UNFINISHED, Finding
from logvggt_jax.doctor.subject import Subject, tiny_config
from logvggt_jax.geometry import decode_poses
from logvggt_jax.streaming import METHODS


@dataclasses.dataclass(frozen=True)
class QuickModel:
    """Depth and poses from two parameters of the real model, so that a training step of all of them compiles soon."""

    config: ModelConfig

    def apply(self, variables: Any, images: jax.Array, frame_mask: Any = None, *, remat: bool = False) -> Predictions:
        params, pixels = variables["params"], images.astype(jnp.float32) / 255.0
        gain = jax.tree.leaves(params["depth_head"])[0].mean()
        pose = (
            jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.8, 1.0]) + jax.tree.leaves(params["camera_head"])[0].mean()
        )
        poses = pose * (1.0 + pixels.mean((2, 3, 4)))[..., None]
        depth = jnp.exp(gain * pixels.mean(-1))
        extrinsics, intrinsics = decode_poses(poses, images.shape[2:4])
        return Predictions(
            pose_encoding=poses,
            pose_encodings=poses[:, :, None],
            extrinsics=extrinsics,
            intrinsics=intrinsics,
            depth=depth,
            depth_confidence=1.0 + depth,
            camera_tokens=poses,
            register_tokens=poses[:, :, None],
        )


@pytest.mark.parametrize("part", [part for part in examination.SHARES if part != "environment"])
def test_every_part_finds_a_cpu_sound(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The real model's own step is compiled by the test of `train.py`; this one has its parameters, loss and optimiser.
    real = training.make_loss_terms
    monkeypatch.setattr(training, "make_loss_terms", lambda model, loss: real(QuickModel(model.config), loss))
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


@pytest.mark.parametrize(("method", "rates"), [("rolling", 2), pytest.param("chunks", 1, marks=pytest.mark.slow)])
def test_a_method_is_timed_and_on_a_cpu_compared_with_nothing(method: str, rates: int) -> None:
    findings = list(examination.part_findings(method, tiny=True, quick=True))
    assert {finding.part for finding in findings} == {method}
    found = [finding for finding in findings if finding.unit == "frames/s"]
    assert len(found) == rates and all(isinstance(each.value, float) and each.value > 0 for each in found)
    assert all(finding.ok is None and not finding.note for finding in findings)


@pytest.mark.slow
def test_eight_bits_are_compared_with_bfloat16() -> None:
    pytest.importorskip("qwix", reason="qwix is not installed (extra `lowprecision`)")
    findings = {finding.what: finding for finding in examination.part_findings("precision", tiny=True, quick=True)}
    assert not [finding for finding in findings.values() if finding.ok is False]
    depth = [findings[f"{name}: depth"].value for name in ("int8", "fp8")]
    assert all(findings[f"{name}: depth"].ok for name in ("int8", "fp8"))
    # Seven bits of a token's largest value against three bits of every value.
    assert isinstance(depth[0], float) and isinstance(depth[1], float) and 0.0 < depth[0] < depth[1]


def test_a_step_in_eight_bits_is_timed_beside_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("qwix", reason="qwix is not installed (extra `lowprecision`)")
    monkeypatch.delitem(precision.PRECISIONS, "fp8")  # which would be one more program
    subject = Subject(LogVGGT(tiny_config("bfloat16")), (28, 42), tiny=True, quick=True)
    found = list(precision.step_times(subject, {"int8": "a note"}))
    assert [finding.what.split(":")[0] for finding in found] == ["bfloat16", "int8"]
    assert [finding.note for finding in found] == ["", "a note"]
    assert all(isinstance(finding.value, float) and finding.value > 0 and finding.unit == "ms" for finding in found)


def test_without_qwix_the_part_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "qwix", None)
    (finding,) = examination.part_findings("precision", tiny=True, quick=True)
    assert (finding.value, finding.ok) == (None, None) and "lowprecision" in finding.note


def test_rates_are_judged_where_the_originals_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    large = Subject(LogVGGT(tiny_config()), (392, 518), tiny=False, quick=False)

    def judged(rate: float, frames: int, kind: str) -> Finding:
        monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(device_kind=kind)])
        return methods._rate("causal", "rate", rate, frames, large)

    last, h100 = methods.STREAMED - 1, "NVIDIA H100 80GB HBM3"
    assert [judged(rate, last, h100).ok for rate in (4.9, 5.1)] == [False, True]
    assert "2.00 x the 10.9 of StreamVGGT's PyTorch code" in judged(21.8, 0, h100).note
    other = judged(4.9, last, "NVIDIA A10")
    assert other.ok is None and "0.98 x the 5.0" in other.note
    assert methods._rate("pruned", "rate", 1.0, 0, large) == Finding("pruned", "rate", 1.0, "frames/s")


def test_every_method_has_a_part_and_time_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, float] = {}
    monkeypatch.setattr(
        examination, "_in_own_process", lambda part, limit, **_: asked.update({part: limit}) or iter(())
    )
    assert main(["doctor", "--methods"]) == 0
    assert list(asked) == list(METHOD_NAMES) and set(METHODS) == set(METHOD_NAMES)
    shares = [examination.METHOD_SHARE[1] * (i + 1) for i in range(len(METHOD_NAMES))]
    assert list(asked.values()) == pytest.approx(shares, abs=1), "what the ones before left is theirs"


def test_a_machine_that_computes_otherwise_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    with resources.files("logvggt_jax.doctor").joinpath(parity.RECORDED).open("rb") as file:
        right = dict(np.load(file))
    assert all(np.isfinite(value).all() for value in right.values())
    for name in right:
        wrong = {**right, name: right[name] + 1e-3 * (right[name] - right[name].mean())}
        monkeypatch.setattr(parity, "outputs", lambda dtype, wrong=wrong: wrong)
        judged = {finding.what: finding.ok for finding in parity.examine()}
        assert [what for what, ok in judged.items() if not ok] == [f"{name}, float32"]


def test_the_command_runs_parts_in_processes_of_their_own(capfd: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor", "--part", "environment", "--part", "environment", "--json"])
    findings = [Finding(**json.loads(line)) for line in capfd.readouterr().out.splitlines()]
    assert [finding.what for finding in findings if finding.what in ("Python", "jax", "devices", "time")] == [
        "Python", "jax", "devices", "time",
    ]  # fmt: skip
    assert code == int(any(finding.ok is False for finding in findings))


def stand_ins(monkeypatch: pytest.MonkeyPatch, programs: dict[str, str]) -> None:
    """Parts whose processes run these programs instead."""

    def popen(command: list[str], **options: object) -> subprocess.Popen:
        return real([sys.executable, "-c", programs[command[5]]], **options)  # type: ignore[call-overload]

    real = subprocess.Popen
    monkeypatch.setattr(examination.subprocess, "Popen", popen)


FOUND = f"import time; print({Finding('whole', 'rate', 5.0).to_json()!r}, flush=True);"


def test_a_part_that_fails_or_takes_too_long_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_ins(monkeypatch, {"parity": "raise SystemExit('no luck')", "whole": FOUND + "time.sleep(60)"})
    shown: list[Finding] = []
    assert not examination.examine(["parity"], tiny=True, quick=True, show=shown.append)
    assert {finding.part: finding.note for finding in shown if finding.ok is False} == {"parity": "no luck"}
    monkeypatch.setattr(examination, "TOTAL", (2, 2))
    monkeypatch.setattr(examination, "SHARES", {"whole": (2, 2)})
    assert not examination.examine(["whole"], tiny=True, quick=True, show=shown.append)
    (late,) = [finding for finding in shown if finding.value == UNFINISHED]
    assert late.ok is None and "limit of 2 s" in late.note, "slow is not wrong"
    assert Finding("whole", "rate", 5.0) in shown, "what was found before the end counts"


def test_a_part_ends_with_whoever_reads_its_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither its process nor the timer of its limit outlives them."""
    stand_ins(monkeypatch, {"whole": FOUND + "time.sleep(60)"})
    processes: list[subprocess.Popen] = []
    popen = examination.subprocess.Popen

    def watched(*given: Any, **options: Any) -> subprocess.Popen:
        processes.append(popen(*given, **options))
        return processes[-1]

    monkeypatch.setattr(examination.subprocess, "Popen", watched)
    timers = {thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)}
    findings = examination._in_own_process("whole", 50.0, tiny=True, quick=True)
    assert next(findings) == Finding("whole", "rate", 5.0)
    findings.close()
    (process,) = processes
    assert process.returncode is not None
    for thread in set(threading.enumerate()) - timers:
        assert not isinstance(thread, threading.Timer) or thread.finished.is_set()


def test_time_that_one_part_leaves_is_the_next_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[float] = []
    monkeypatch.setattr(examination, "_in_own_process", lambda part, limit, **_: limits.append(limit) or iter(()))
    for column, total in enumerate(examination.TOTAL):
        shares = [share[column] for share in examination.SHARES.values()]
        assert sum(shares) == total
        limits.clear()
        examination.examine(list(examination.SHARES), tiny=True, quick=column == 0, show=print)
        assert limits == pytest.approx([total - sum(shares[i + 1 :]) for i in range(len(shares))], abs=1)


def test_what_is_wrong_is_no_failure_of_its_part(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def findings(*_: object, **__: object) -> Iterator[Finding]:
        yield Finding("parity", "depth", 1.0, ok=False)
        assert "depth" in capsys.readouterr().out, "shown as it comes"
        yield Finding("parity", "pose", 0.0, ok=True)

    monkeypatch.setattr(examination, "part_findings", findings)
    assert main(["doctor", "--part", "parity", "--in-process"]) == 0, "the part ran to its end"


def test_findings_are_written_beside_the_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    found = Finding("whole", "rate", 5.0, "frames/s", ok=False)
    monkeypatch.setattr(examination, "_in_own_process", lambda *_, **__: iter([found]))
    assert main(["doctor", "--part", "whole", "--json", str(tmp_path / "found.jsonl")]) == 1
    assert Finding(**json.loads((tmp_path / "found.jsonl").read_text())) == found
    assert "5 frames/s  WRONG" in capsys.readouterr().out
    assert main(["doctor", "--part", "whole", "--json", str(tmp_path / "none" / "found.jsonl")]) == 2


def test_a_back_end_that_failed_says_why_the_gpu_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*kinds: str) -> list[jax.Device]:
        if kinds:
            raise RuntimeError("Backend 'cuda' failed to initialize: CUDA driver version is insufficient")
        return real()

    real = jax.devices
    monkeypatch.setattr(environment, "nvidia_gpu_present", lambda: True)
    monkeypatch.setattr(jax, "devices", refuse)
    wrong = {finding.what: finding.note for finding in environment.examine() if finding.ok is False}
    assert "driver version is insufficient" in wrong["NVIDIA GPU"]


def test_builds_side_by_side_and_idle_gpus_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["jax", "nvidia-nccl-cu12", "nvidia-nccl-cu13", "nvidia-cudnn-cu13", "jax-cuda13-pjrt"]
    names += ["jax-cuda12-plugin", "jax-cuda13-plugin"]
    installed = [SimpleNamespace(metadata={"Name": name}, version="1") for name in names]
    monkeypatch.setattr(importlib.metadata, "distributions", lambda: installed)
    monkeypatch.setattr(environment, "nvidia_gpu_present", lambda: True)
    wrong = {finding.what: finding for finding in environment.examine() if finding.ok is False}
    assert wrong["builds of nvidia-nccl-cu*"].value == "nvidia-nccl-cu12, nvidia-nccl-cu13"
    assert wrong["builds of jax-cuda*-plugin"].value == "jax-cuda12-plugin, jax-cuda13-plugin"
    assert "builds of nvidia-cudnn-cu*" not in wrong and "builds of jax-cuda*-pjrt" not in wrong
    assert "logvggt-jax[cuda]" in wrong["NVIDIA GPU"].note
    assert wrong["flax"].value_text() == "-"


def test_a_back_end_that_does_not_start_is_one_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise RuntimeError("Unable to initialize backend 'cuda':\ndriver too old")

    monkeypatch.setattr(jax, "devices", refuse)
    last = list(environment.examine())[-1]
    assert (last.what, last.ok) == ("devices", False)
    assert "driver too old" in last.note


def test_an_unknown_part_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--part", "brain"]) == 2
    assert "no part 'brain'; it has environment" in capsys.readouterr().err
