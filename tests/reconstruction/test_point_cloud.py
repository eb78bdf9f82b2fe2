"""Point clouds hold the chosen pixels' points, in the number announced, at constant memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.point_cloud import (
    VERTEX,
    PointFilter,
    PointSelection,
    count_points,
    frame_vertices,
    read_points,
    write_points,
)


def random_frames(count: int = 5) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(0)
    shape = (count, 24, 32)
    depth = generator.uniform(1, 1.05, shape).astype(np.float32)
    confidence = (1 + np.exp(generator.normal(0, 2, shape))).astype(np.float32)
    return list(zip(depth, confidence, strict=True))


def select(point_filter: PointFilter, frames: list) -> tuple[PointSelection, list[np.ndarray]]:
    """The selection and each frame's points; frames pass in another order, as they do through threads."""
    selection = PointSelection(point_filter)
    order = np.random.default_rng(0).permutation(len(frames)).tolist()
    for index in order:
        selection.count(*frames[index])
    chosen = {index: selection.choose(index, *frames[index]) for index in order}
    indices = []
    for index in range(len(frames)):
        found, qualified = chosen[index]
        quota = selection.quota(qualified)
        assert quota <= len(found) <= quota + 1
        indices.append(found[:quota])
    return selection, indices


def test_points_are_the_unprojected_pixels_with_their_colours() -> None:
    generator = np.random.default_rng(0)
    depth = generator.uniform(1, 3, (4, 6)).astype(np.float32)
    image = generator.integers(0, 256, (4, 6, 3), np.uint8)
    intrinsics = np.array([[5.0, 0, 3], [0, 6, 2], [0, 0, 1]])
    angle = 0.3
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    extrinsics = np.concatenate([rotation, [[0.5], [-1], [2]]], axis=1)
    vertices = frame_vertices(depth, image, intrinsics, extrinsics, np.array([0, 9, 23]))
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
    write_points(tmp_path / "p.ply", 12, iter(chunks))
    written = np.concatenate(chunks)
    points, colours = read_points(tmp_path / "p.ply")
    assert points.dtype == np.float32 and colours.dtype == np.uint8
    # Another library reads the same.
    cloud = trimesh.load(tmp_path / "p.ply")
    for found, colour in ((points, colours), (cloud.vertices, cloud.colors[:, :3])):
        np.testing.assert_array_equal(found, np.stack([written[name] for name in "xyz"], axis=-1))
        np.testing.assert_array_equal(colour, np.stack([written[name] for name in ("red", "green", "blue")], axis=-1))
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
    for content in (whole[:-1], whole + b"\0", whole[:50], b"", whole.replace(b"float x", b"float w")):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"p\.ply is not a point cloud of this program, or is cut off"):
            count_points(path)


@pytest.mark.parametrize("announced", [2, 4])
def test_a_wrong_number_of_points_leaves_no_file(tmp_path: Path, announced: int) -> None:
    with pytest.raises(ValueError, match=f"{announced} vertices announced, 3 given"):
        write_points(tmp_path / "p.ply", announced, [np.zeros(3, VERTEX)])
    assert list(tmp_path.iterdir()) == []


def test_each_frame_is_written_before_the_next_is_made(tmp_path: Path) -> None:
    alive: list[int] = []

    class Frame(np.ndarray):
        def __del__(self) -> None:
            alive.append(-1)

    def chunks():
        for _ in range(20):
            alive.append(1)
            assert sum(alive) <= 2
            yield np.zeros(10, VERTEX).view(Frame)

    write_points(tmp_path / "p.ply", 200, chunks())
    assert count_points(tmp_path / "p.ply") == 200


def test_percentile_leaves_out_the_least_confident() -> None:
    frames = random_frames()
    confidence = np.concatenate([c.reshape(-1) for _, c in frames])
    selection, chosen = select(PointFilter(40, edge_threshold=None, max_points=None), frames)
    kept = np.concatenate([c.reshape(-1)[i] for (_, c), i in zip(frames, chosen, strict=True)])
    assert len(kept) == selection.num_points
    assert abs(len(kept) / len(confidence) - 0.6) < 0.01
    # To the 11 bits that files keep.
    assert kept.min() >= np.quantile(confidence, 0.4) * (1 - 2**-11)


def test_equal_confidences_are_all_kept() -> None:
    frames = [(np.ones((4, 5), np.float32), np.ones((4, 5), np.float32))] * 2
    selection, chosen = select(PointFilter(50, max_points=None), frames)
    assert selection.num_points == sum(map(len, chosen)) == 40


@pytest.mark.parametrize("limit", [1, 100, 1234, 10**6])
def test_thinning_gives_exactly_the_announced_number_evenly(limit: int) -> None:
    frames = random_frames()
    point_filter = PointFilter(10, max_points=limit)
    selection, chosen = select(point_filter, frames)
    counts = [len(indices) for indices in chosen]
    assert sum(counts) == selection.num_points == min(limit, selection.num_qualified)
    if limit == 1234:
        assert max(counts) - min(counts) < 0.1 * max(counts)
    for indices in chosen:
        assert (np.diff(indices) > 0).all()
    for again, before in zip(select(point_filter, frames)[1], chosen, strict=True):
        np.testing.assert_array_equal(again, before)


def test_stride_invalid_depth_and_edges() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0, 0], depth[2, 2], depth[4, 4] = 0, np.nan, np.inf
    confidence = np.full((6, 8), 2.0, np.float32)
    sparse = PointFilter(0, edge_threshold=None, pixel_stride=2).candidates(depth, confidence)
    assert sparse.sum() == 3 * 4 - 3
    step = np.full((6, 8), 2.0, np.float32)
    step[:, 4:] = 3.0
    edges = ~PointFilter(0, edge_threshold=0.1).candidates(step, confidence)
    expected = np.zeros((6, 8), bool)
    expected[:, 3:5] = True
    np.testing.assert_array_equal(edges, expected)


def test_nothing_valid_gives_no_points() -> None:
    frames = [(np.zeros((4, 5), np.float32), np.ones((4, 5), np.float32))]
    selection, chosen = select(PointFilter(), frames)
    assert selection.num_points == 0
    assert chosen[0].size == 0


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"confidence_percentile": 100}, "confidence_percentile"),
        ({"edge_threshold": 0.0}, "edge_threshold"),
        ({"pixel_stride": 0}, "pixel_stride"),
        ({"max_points": 0}, "max_points"),
    ],
)
def test_options_out_of_range_are_named(options: dict, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        PointFilter(**options)
