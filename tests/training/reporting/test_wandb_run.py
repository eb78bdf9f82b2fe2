"""Weights & Biases gets what TensorBoard gets, in one run however often the work folder's run was interrupted."""

import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from logvggt_jax.errors import InputError, MissingPackage
from logvggt_jax.training.reporting.metrics_log import MetricsLog
from logvggt_jax.training.reporting.wandb_run import WandbRun


class Library(ModuleType):
    """What of the library is used, without network; takes down what it is told."""

    def __init__(self) -> None:
        super().__init__("wandb")
        self.runs: list[dict[str, Any]] = []
        self.lines: list[tuple[int, dict[str, Any]]] = []
        self.ended: list[int] = []
        self.Image = lambda picture: ("image", picture.shape)
        self.fails = False

    def init(self, **options: Any) -> SimpleNamespace:
        if os.environ.get("WANDB_MODE") != "offline":
            raise RuntimeError("api_key not configured (no-tty).\ncall wandb.login")
        self.runs.append(options)
        return SimpleNamespace(log=self.log, finish=lambda exit_code: self.ended.append(exit_code))

    def log(self, values: dict[str, Any], *, step: int) -> None:
        if self.fails:
            raise ConnectionError("away")
        self.lines.append((step, values))


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Library:
    library = Library()
    monkeypatch.setitem(sys.modules, "wandb", library)
    monkeypatch.setenv("WANDB_MODE", "offline")
    return library


def test_it_gets_scalars_times_and_pictures_of_one_run(library: Library, tmp_path: Path) -> None:
    workdir = tmp_path / "run"
    for first in (0, 1):
        with (
            WandbRun("rooms", workdir, {"seed": 0}) as run,
            MetricsLog(workdir, first_step=first, console=Console(quiet=True), wandb=run) as log,
        ):
            log.write(first + 1, {"loss": 0.5, "bad": float("nan")})
            log.write_times(first + 1, {"productive_seconds": 1.0})
            log.show(first + 1, {"validation/rooms/clip": np.zeros((4, 6, 3), np.uint8)})
    first, second = library.runs
    assert first == second and len(first["id"]) == 16 and first["resume"] == "allow"
    assert (first["project"], first["name"], first["config"]) == ("rooms", "run", {"seed": 0})
    assert library.lines[-3:] == [
        (2, {"loss": 0.5}),
        (2, {"times/productive_seconds": 1.0}),
        (2, {"validation/rooms/clip": ("image", (4, 6, 3))}),
    ]
    assert library.ended == [0, 0]


def test_a_service_that_is_away_ends_no_run(library: Library, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with WandbRun("rooms", tmp_path, {}) as run:
        library.fails = True
        run.write(3, {"loss": 0.5})
    assert "step 3 is not on Weights & Biases: away" in caplog.text


def test_what_keeps_it_from_beginning_is_one_line(
    library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WANDB_MODE")
    with pytest.raises(InputError, match=r"--wandb=rooms: no run .*api_key not configured.*WANDB_MODE=offline"):
        WandbRun("rooms", tmp_path, {})
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingPackage, match=r'pip install "logvggt-jax\[wandb\]"'):
        WandbRun("rooms", tmp_path, {})


@pytest.mark.slow
def test_the_real_library_keeps_a_run_on_the_disk_until_it_is_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    workdir, picture = tmp_path / "run", np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    for first in (0, 1):
        with (
            WandbRun("rooms", workdir, {"seed": 1234567}) as run,
            MetricsLog(workdir, first_step=first, console=Console(quiet=True), wandb=run) as log,
        ):
            log.write(first + 1, {"loss/total": 0.5})
            log.write_times(first + 1, {"productive_seconds": 1.0})
            log.show(first + 1, {"validation/rooms/clip": picture})
    identity = (workdir / "wandb_id").read_text()
    folders = list((workdir / "wandb").glob("offline-run-*"))
    assert folders and all(folder.name.endswith(f"-{identity}") for folder in folders)
    records = b"".join((folder / f"run-{identity}.wandb").read_bytes() for folder in folders)
    for written in (b"rooms", b"1234567", b"loss/total", b"times/productive_seconds", b"validation/rooms/clip"):
        assert written in records
    shown = [path for folder in folders for path in (folder / "files").rglob("*.png")]
    assert {path.name.rpartition("_")[0] for path in shown} == {"clip_1", "clip_2"}
    for path in shown:
        np.testing.assert_array_equal(np.asarray(Image.open(path)), picture)
