"""A result folder has a handle; exporters read it and nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from result_folder import SIZE, write_result

from logvggt_jax.errors import InputError
from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.exporters import EXPORTERS
from logvggt_jax.reconstruction.exporters.tum import read_trajectory
from logvggt_jax.reconstruction.point_cloud import PointFilter, read_points
from logvggt_jax.reconstruction.result import Reconstruction


def test_the_handle_gives_what_the_folder_holds(tmp_path: Path) -> None:
    write_result(tmp_path)
    result = Reconstruction.open(tmp_path)
    assert result.names == ("0", "1", "2") and result.num_frames == 3
    assert result.image_size == (48, 64) and result.depth_size == SIZE
    np.testing.assert_array_equal(result.timestamps, [0, 1, 2])
    np.testing.assert_array_equal(camera_centres(result.extrinsics)[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(result.depth_intrinsics[:, 0, 2] * 2, result.intrinsics[:, 0, 2])
    assert (result.depth(1) == 2).all() and (result.confidence(1) == 2).all()
    image = result.image(2)
    assert image.dtype == np.uint8 and image.shape == (*SIZE, 3) and np.abs(image.astype(int) - 80).max() <= 2
    points, colours = result.points()
    np.testing.assert_array_equal(points[:, 2], np.arange(10))
    assert colours.shape == (10, 3) and result.num_points == 10


@pytest.mark.parametrize("name", ["cameras.json", "depth/1.npz", "images/2.jpg", "points.ply"])
def test_a_partial_folder_is_refused_and_the_file_named(tmp_path: Path, name: str) -> None:
    write_result(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(InputError, match=name) as caught:
        Reconstruction.open(tmp_path)
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["cameras.json", "depth/1.npz", "images/1.jpg", "points.ply"])
@pytest.mark.parametrize("kept", [0, 0.5])
def test_a_damaged_file_is_named_when_it_is_read(tmp_path: Path, name: str, kept: float) -> None:
    write_result(tmp_path)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match=name) as caught:
        result = Reconstruction.open(tmp_path)
        result.depth(1)
        result.image(1)
    assert "\n" not in str(caught.value)


def test_results_of_before_images_were_kept_still_open(tmp_path: Path) -> None:
    write_result(tmp_path)
    shutil.rmtree(tmp_path / "images")
    result = Reconstruction.open(tmp_path)
    assert (result.depth(0) == 2).all()
    with pytest.raises(InputError, match=r"images/0\.jpg does not exist"):
        result.image(0)


def test_every_exporter_writes_its_file_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "exported").mkdir()
    write_result(tmp_path / "result")
    result = Reconstruction.open(tmp_path / "result")
    assert set(EXPORTERS) >= {"ply", "tum"}
    for name, export in EXPORTERS.items():
        export(result, tmp_path / "exported" / name, progress=False)
    assert {path.name for path in (tmp_path / "exported").iterdir()} == set(EXPORTERS)


def test_the_cloud_is_every_frame_unprojected_in_its_own_colour(tmp_path: Path) -> None:
    write_result(tmp_path)
    result = Reconstruction.open(tmp_path)
    every = PointFilter(confidence_percentile=0, edge_threshold=None, max_points=None)
    EXPORTERS["ply"](result, tmp_path / "all.ply", point_filter=every, progress=False)
    points, colours = read_points(tmp_path / "all.ply")
    pixels = SIZE[0] * SIZE[1]
    assert len(points) == 3 * pixels
    assert (points[:, 2] == 2).all()
    for index in range(3):
        part = slice(index * pixels, (index + 1) * pixels)
        # The first pixel lies 16 columns left of the centre of projection, at 25 pixels of focal length and depth 2.
        assert points[part][0, 0] == pytest.approx(index - 2 * 16 / 25)
        assert np.abs(colours[part].astype(int) - 40 * index).max() <= 2


def test_the_trajectory_is_the_cameras(tmp_path: Path) -> None:
    write_result(tmp_path)
    result = Reconstruction.open(tmp_path)
    EXPORTERS["tum"](result, tmp_path / "path.txt")
    timestamps, extrinsics = read_trajectory(tmp_path / "path.txt")
    np.testing.assert_array_equal(timestamps, result.timestamps)
    np.testing.assert_allclose(extrinsics[:, :3], result.extrinsics, atol=1e-8)
