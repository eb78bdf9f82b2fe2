"""Clouds are read as they were written, in the number announced; other and damaged files are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.points.cloud_file import (
    VERTEX,
    count_points,
    frame_vertices,
    read_cloud,
    read_points,
    write_points,
)
from logvggt_jax.reconstruction.points.frame_points import FramePoints


def test_points_are_the_unprojected_pixels_with_their_colours() -> None:
    generator = np.random.default_rng(0)
    depth = generator.uniform(1, 3, (4, 6)).astype(np.float32)
    image = generator.integers(0, 256, (4, 6, 3), np.uint8)
    intrinsics = np.array([[5.0, 0, 3], [0, 6, 2], [0, 0, 1]])
    angle = 0.3
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    extrinsics = np.concatenate([rotation, [[0.5], [-1], [2]]], axis=1)
    indices = np.array([0, 9, 23])
    confidence = np.array([1, 2, 4], np.float16)
    points = FramePoints(indices, depth.reshape(-1)[indices], image.reshape(-1, 3)[indices], confidence)
    vertices = frame_vertices(points, depth.shape, intrinsics, extrinsics, 7)
    assert vertices["confidence"].tolist() == [1, 2, 4] and vertices["frame"].tolist() == [7, 7, 7]
    for vertex, (row, column) in zip(vertices, [(0, 0), (1, 3), (3, 5)], strict=True):
        z = depth[row, column]
        camera = np.array([(column - 3) * z / 5, (row - 2) * z / 6, z])
        world = rotation.T @ (camera - extrinsics[:, 3])
        np.testing.assert_allclose([vertex["x"], vertex["y"], vertex["z"]], world, rtol=1e-5, atol=1e-6)
        assert [vertex["red"], vertex["green"], vertex["blue"]] == image[row, column].tolist()


def test_ply_holds_what_was_written(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    chunks = [np.empty(count, VERTEX) for count in (5, 0, 7)]
    for chunk in chunks:
        for name in VERTEX.names:
            chunk[name] = generator.integers(0, 256, len(chunk))
    for number, chunk in enumerate(chunks):
        chunk["frame"] = number
    write_points(tmp_path / "p.ply", 12, iter(chunks))
    written = np.concatenate(chunks)
    points, colours = read_points(tmp_path / "p.ply")
    assert points.dtype == np.float32 and colours.dtype == np.uint8
    # Another library reads the same.
    cloud = trimesh.load(tmp_path / "p.ply")
    for found, colour in ((points, colours), (cloud.vertices, cloud.colors[:, :3])):
        np.testing.assert_array_equal(found, np.stack([written[name] for name in "xyz"], axis=-1))
        np.testing.assert_array_equal(colour, np.stack([written[name] for name in ("red", "green", "blue")], axis=-1))
    cloud = read_cloud(tmp_path / "p.ply")
    for name in ("confidence", "frame"):
        np.testing.assert_array_equal(getattr(cloud, name), written[name])
    assert count_points(tmp_path / "p.ply") == 12
    assert [path.name for path in tmp_path.iterdir()] == ["p.ply"]


def test_an_empty_cloud_is_a_valid_file(tmp_path: Path) -> None:
    write_points(tmp_path / "p.ply", 0, iter([]))
    assert count_points(tmp_path / "p.ply") == 0
    assert read_points(tmp_path / "p.ply")[0].shape == (0, 3)


def test_other_and_damaged_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "p.ply"
    with pytest.raises(InputError, match=r"p\.ply does not exist"):
        count_points(path)
    write_points(path, 3, [np.zeros(3, VERTEX)])
    whole = path.read_bytes()
    for content, complaint in (
        (whole[:-1], "cut off: 3 points need 289 bytes, it has 288"),
        (whole + b"\0", "longer than its header says: 3 points need 289 bytes, it has 290"),
        (whole[:50], "cut off in its header"),
        (b"", "empty"),
        (b"\x89PNG", "no PLY file"),
        (whole.replace(b"float x", b"float w"), "a PLY file of another program"),
        (whole.replace(b"vertex 3", b"vertex 3" + 30 * b"0"), "a PLY file of another program"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"p\.ply is {complaint}"):
            count_points(path)


def test_clouds_of_earlier_versions_without_confidence_and_frame_are_read(tmp_path: Path) -> None:
    path = tmp_path / "p.ply"
    vertices = np.zeros(2, VERTEX)
    vertices["x"], vertices["blue"] = [1, 2], [3, 4]
    write_points(path, 2, [vertices])
    header = path.read_bytes().split(b"end_header\n")[0]
    header = header.replace(b"property float confidence\nproperty int frame\n", b"")
    body = b"".join(vertex.tobytes()[:15] for vertex in vertices)
    path.write_bytes(header + b"end_header\n" + body)
    cloud = read_cloud(path)
    assert cloud.confidence is None and cloud.frame is None
    assert cloud.points[:, 0].tolist() == [1, 2] and cloud.colours[:, 2].tolist() == [3, 4]


@pytest.mark.parametrize(("name", "values"), [("frame", [2, 1]), ("frame", [-1, 0]), ("confidence", [1, np.inf])])
def test_a_cloud_whose_confidences_or_frames_make_no_sense_is_refused(tmp_path: Path, name: str, values: list) -> None:
    vertices = np.zeros(2, VERTEX)
    vertices[name] = values
    write_points(tmp_path / "p.ply", 2, [vertices])
    with pytest.raises(InputError, match=r"p\.ply is damaged: its points' confidences or frames"):
        read_cloud(tmp_path / "p.ply")


def test_a_cloud_with_points_that_are_not_finite_is_refused(tmp_path: Path) -> None:
    vertices = np.zeros(3, VERTEX)
    vertices["y"][1] = np.nan
    write_points(tmp_path / "p.ply", 3, [vertices])
    with pytest.raises(InputError, match=r"p\.ply is damaged: 1 of its 3 points are not finite"):
        read_points(tmp_path / "p.ply")


@pytest.mark.parametrize("most", [3, 4, 99, 100, 12345])
def test_fewer_points_than_announced_are_a_file_of_that_many(tmp_path: Path, most: int) -> None:
    vertices = np.zeros(3, VERTEX)
    vertices["x"] = [1, 2, 3]
    write_points(tmp_path / "p.ply", most, [vertices])
    assert count_points(tmp_path / "p.ply") == 3
    for points in (read_points(tmp_path / "p.ply")[0], trimesh.load(tmp_path / "p.ply").vertices):
        np.testing.assert_array_equal(points[:, 0], [1, 2, 3])


def test_more_points_than_announced_leave_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="2 vertices announced, 3 given"):
        write_points(tmp_path / "p.ply", 2, [np.zeros(3, VERTEX)])
    assert list(tmp_path.iterdir()) == []
