"""A result folder has a handle; exporters read it and nothing else."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from result_folder import SIZE, write_result

from logvggt_jax.errors import InputError
from logvggt_jax.geometry import camera_centres
from logvggt_jax.reconstruction.depth_files import write_picture
from logvggt_jax.reconstruction.exporters.ply import export_ply
from logvggt_jax.reconstruction.exporters.tum import export_tum, read_trajectory
from logvggt_jax.reconstruction.points.cloud_file import read_points
from logvggt_jax.reconstruction.points.point_filter import PointFilter
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


def test_a_file_in_a_folders_place_is_called_one(tmp_path: Path) -> None:
    write_result(tmp_path)
    with pytest.raises(InputError, match=r"points\.ply is a file: give the folder"):
        Reconstruction.open(tmp_path / "points.ply")


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


def with_cameras(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the content of cameras.json."""
    document = json.loads((folder / "cameras.json").read_text())
    change(document)
    (folder / "cameras.json").write_text(json.dumps(document))


def frame_with(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda document: document["frames"][1].update(values)


EYE = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda d: d.update(frames=[]), "frames must be a list of cameras"),
        (lambda d: d.update(frames={"0": 1}), "frames must be a list of cameras"),
        (lambda d: d["frames"].append(7), "frame 3 is no object"),
        (lambda d: d.pop("depth_size"), "depth_size must be height and width"),
        (lambda d: d.update(image_size=[0, 64]), "image_size must be height and width"),
        (lambda d: d.update(depth_size=[24, 1e400]), "depth_size must be height and width"),
        (lambda d: d.update(depth_size=[48, 32]), r"depth/0\.npz: depth must be floats \[48, 32\].*got \[24, 32\]"),
        (lambda d: d.update(source={"path": 1}), "source must be null or say where"),
        (lambda d: d.update(metric="yes"), "metric must be true or false"),
        (lambda d: d["points"].update(edges=1), r"unknown field points\.edges"),
        (lambda d: d["points"].update(pixel_stride=0), "pixel_stride must be at least 1 pixel, got 0"),
        (lambda d: d["points"].update(edge_threshold="0.1"), r"points\.edge_threshold must be a number"),
        (lambda d: d.update(points=[2]), "points"),
        (frame_with(name="../../secret"), "cannot be that of a file"),
        (frame_with(name=".."), "cannot be that of a file"),
        (frame_with(name="a\0b"), "cannot be that of a file"),
        (frame_with(name=7), "cannot be that of a file"),
        (frame_with(name="0"), "two frames have the name '0'"),
        (frame_with(name=300 * "n"), "too long"),
        (frame_with(timestamp="soon"), "the timestamp of frame 1, '1', must be a number"),
        (frame_with(timestamp=float("nan")), "must be finite"),
        (frame_with(extrinsics=EYE), r"the extrinsics of frame 1, '1', must be numbers \[3, 4\]"),
        (frame_with(extrinsics=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1]]), "must be numbers"),
        (frame_with(extrinsics=[[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]), "must be finite"),
        (frame_with(extrinsics=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "hold no rotation"),
        (frame_with(extrinsics=[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "hold no rotation"),
        (frame_with(intrinsics=[[0, 0, 0], [0, 1, 0], [0, 0, 1]]), "not those of a pinhole camera"),
        (frame_with(depth_scale=0), "the depth_scale of frame 1, '1', must be above 0"),
        (frame_with(depth_scale="twice"), "the depth_scale of frame 1, '1', must be a number"),
        (lambda d: d.update(format="logvggt-cameras-7"), "it is of another version of this program"),
        (lambda d: d.update(loops=[[0, 3]]), "loops must be pairs of positions among the frames"),
        (lambda d: d.update(loops={"0": 1}), "loops must be pairs of positions among the frames"),
        (frame_with(depth_intrinsics=[[10**400, 0, 0], [0, 1, 0], [0, 0, 1]]), "must be numbers"),
    ],
)
def test_cameras_that_cannot_be_used_are_refused_and_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], complaint: str
) -> None:
    write_result(tmp_path)
    with_cameras(tmp_path, change)
    with pytest.raises(InputError, match=complaint) as caught:
        Reconstruction.open(tmp_path).depth(0)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_depth_and_images_of_another_kind_or_size_are_named(tmp_path: Path) -> None:
    write_result(tmp_path)
    result = Reconstruction.open(tmp_path)
    np.savez(tmp_path / "depth" / "0.npz", depth=np.zeros(SIZE, complex), confidence=np.zeros(SIZE, np.float16))
    with pytest.raises(InputError, match=r"depth/0\.npz: depth must be floats .* got \[24, 32\] of complex128"):
        result.depth(0)
    np.savez(tmp_path / "depth" / "0.npz", depth=np.zeros(SIZE, np.float16), confidence=np.zeros(5, np.float16))
    with pytest.raises(InputError, match=r"depth/0\.npz: confidence must be floats .* got \[5\]"):
        result.depth(0)
    write_picture(tmp_path / "images" / "0.jpg", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputError, match=r"images/0\.jpg has 8 x 8 pixels, expected 24 x 32"):
        result.image(0)


def test_results_of_before_images_were_kept_still_open(tmp_path: Path) -> None:
    write_result(tmp_path)
    shutil.rmtree(tmp_path / "images")
    result = Reconstruction.open(tmp_path)
    assert (result.depth(0) == 2).all()
    with pytest.raises(InputError, match=r"images/0\.jpg does not exist"):
        result.image(0)


def test_the_cloud_is_every_frame_unprojected_in_its_own_colour(tmp_path: Path) -> None:
    write_result(tmp_path)
    result = Reconstruction.open(tmp_path)
    every = PointFilter(confidence_percentile=0, edge_threshold=None, max_points=None)
    export_ply(result, tmp_path / "all.ply", point_filter=every, progress=False)
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
    export_tum(result, tmp_path / "path.txt")
    timestamps, extrinsics = read_trajectory(tmp_path / "path.txt")
    np.testing.assert_array_equal(timestamps, result.timestamps)
    np.testing.assert_allclose(extrinsics[:, :3], result.extrinsics, atol=1e-8)
