"""What can be known before the weights are read is known, and stands to what a run then does."""

from __future__ import annotations

import dataclasses
import functools
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image
from recorder import LONGER_EDGE, Recorder, reconstruct_recorded

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import DiskError, InputError
from logvggt_jax.operations import matmul_flops_per_second
from logvggt_jax.reconstruction import PointFilter, open_source
from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.request import check_request, describe, device_needs, disk_bytes
from logvggt_jax.streaming import METHODS, ChunkPlan


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Twelve frames of noise, which compresses worse than any photograph."""
    folder = tmp_path / "walk"
    folder.mkdir()
    pictures = np.random.default_rng(0).integers(0, 256, (12, 112, 168, 3), np.uint8)
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{index:03d}.png")
    return folder


def test_a_result_fits_into_what_was_estimated(walk: Path, tmp_path: Path) -> None:
    result = reconstruct_recorded(Recorder(), walk, tmp_path / "out", num_previews=0, progress=False)
    written = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
    _, estimate = disk_bytes(12, result.depth_size, PointFilter())
    # At so few pixels the names and headers of files weigh as much as what is in them.
    overhead = 12 * 700 + 12_000
    assert estimate * 0.5 < written < estimate * 1.25 + overhead
    assert disk_bytes(None, (392, 518), PointFilter())[0] == 392 * 518 * 5


def test_a_disk_that_is_too_small_is_refused(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, output = open_source(walk), tmp_path / "new" / "out"
    arguments = (source, output, None, "windows", None, LONGER_EDGE, PointFilter())
    lines = describe(*arguments)
    assert lines[0].startswith("12 frames of 168x112 pixels, 42x28 for the model") and "MB are free in" in lines[1]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=100_000))
    with pytest.raises(DiskError, match=r"out: needs about 0\.\d MB, 0\.1 MB are free.*--stride"):
        describe(*arguments)


def test_exports_are_part_of_the_estimate(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = (open_source(walk), tmp_path / "out", None, "windows", None, LONGER_EDGE, PointFilter())
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=650_000))
    for formats in ([], ["tum", "euroc"], ["nerfstudio", "nerfstudio"]):
        describe(*arguments, formats)
    for formats in (["depth-npz"], ["nerfstudio", "depth-png"]):
        with pytest.raises(DiskError, match=r"out: needs about .*fewer formats \(--export\)"):
            describe(*arguments, formats)


def test_an_output_that_cannot_be_made_is_refused(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("x")
    source = open_source(walk)
    options = {"longer_edge": LONGER_EDGE, "overwrite": False}
    assert check_request(source, tmp_path / "new" / "out", **options) == tmp_path / "new" / "out"
    with pytest.raises(DiskError, match=r"file is no folder"):
        check_request(source, tmp_path / "file" / "out", **options)
    with pytest.raises(InputError, match="previews must not be negative"):
        check_request(source, tmp_path / "new" / "out", **options, num_previews=-1)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(DiskError, match="no permission"):
        check_request(source, tmp_path / "new" / "out", **options)


@pytest.fixture(scope="module")
def large_head(small_config: ModelConfig) -> tuple[LogVGGT, int]:
    """A model with many parameters that the program of a stream does not read, and the number of all of them."""
    head = dataclasses.replace(small_config.camera_head, depth=8, iterations=1)
    model = LogVGGT(dataclasses.replace(small_config, camera_head=head))
    shapes = jax.eval_shape(model.init, jax.random.key(0), np.zeros((1, 1, 28, 42, 3), np.float32))
    return model, sum(leaf.size for leaf in jax.tree.leaves(shapes))


@pytest.mark.parametrize(
    "method",
    [name if name in ("windows", "rolling") else pytest.param(name, marks=pytest.mark.slow) for name in METHODS],
)
def test_the_device_needs_its_parameters_and_something_to_work_with(
    large_head: tuple[LogVGGT, int], method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Small products say enough of the rate here.
    rate = functools.partial(matmul_flops_per_second, size=256)
    monkeypatch.setattr("logvggt_jax.reconstruction.request.matmul_flops_per_second", rate)
    model, parameters = large_head
    settings = ChunkPlan(4, 2) if method == "chunks" else None
    needs = device_needs(method, model, settings, (28, 42), 6)
    assert needs.parameters == 4 * parameters
    assert needs.working is not None and needs.working > 28 * 42 * 4
    assert 0 < needs.seconds_a_frame < 60


def test_intrinsics_of_whole_images_are_refused_for_parts_of_them(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for index, size in enumerate(((160, 120), (160, 100), (120, 160))):
        Image.new("RGB", size, (index, 0, 0)).save(tmp_path / "walk" / f"{index}.png")
    options = {"longer_edge": LONGER_EDGE, "overwrite": False}
    calibration = Calibration((150.0, 150.0, 59.5, 49.5))
    source = open_source(tmp_path / "walk", size_mismatch="crop")
    with pytest.raises(InputError, match=r"intrinsics are those of whole images, of which .*walk gives parts"):
        check_request(source, tmp_path / "out", calibration=calibration, **options)
    check_request(source, tmp_path / "out", calibration=Calibration(shared=True), **options)
