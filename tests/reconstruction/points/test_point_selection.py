"""Point clouds hold the chosen pixels' points, in the number announced, at constant memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh

from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction.points.selection import (
    VERTEX,
    FramePoints,
    PointFilter,
    PointSelection,
    count_points,
    frame_vertices,
    read_cloud,
    read_points,
    write_points,
)


def random_frames(count: int = 5) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Depth, confidence and image of some frames."""
    generator = np.random.default_rng(0)
    shape = (count, 24, 32)
    depth = generator.uniform(1, 1.05, shape).astype(np.float32)
    confidence = (1 + np.exp(generator.normal(0, 2, shape))).astype(np.float32)
    return list(zip(depth, confidence, generator.integers(0, 256, (*shape, 3), np.uint8), strict=True))


def select(
    point_filter: PointFilter, frames: list, *, expected_frames: int | None = 5, seed: int = 0
) -> tuple[PointSelection, list[FramePoints]]:
    """The selection and each frame's points; frames are seen and asked for in some order, as threads do."""
    selection = PointSelection(point_filter, expected_frames)
    generator = np.random.default_rng(seed)
    for index in generator.permutation(len(frames)).tolist():
        selection.see(index, *frames[index])
    chosen = {
        index: selection.choose(index, lambda i=index: frames[i])
        for index in generator.permutation(len(frames)).tolist()
    }
    return selection, [chosen[index] for index in range(len(frames))]


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


def test_candidates_stay_within_bounds_whatever_length_was_announced() -> None:
    """A header may say one frame where a thousand follow: the samples of all together keep to the bound."""
    frames = random_frames(40)
    point_filter = PointFilter(0, edge_threshold=None, max_points=40_000)
    sizes: dict[int, int] = {}
    for announced in (1, 1000):
        tracemalloc.start()
        selection = PointSelection(point_filter, announced)
        for index in range(1000):
            selection.see(index, *frames[index % 40])
        sizes[announced] = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
    # Twice the points wanted, 17 bytes each, and what a thousand small objects weigh.
    assert sizes[1] < 1.1 * sizes[1000] and sizes[1000] < 80_000 * 17 + 1000 * 1500


@pytest.mark.parametrize("announced", [1, 7, 100])
def test_a_wrong_length_changes_neither_number_nor_determinism(announced: int) -> None:
    frames = random_frames(60)
    for depth, _, _ in frames[::2]:
        depth[:12] = 0
    point_filter = PointFilter(25, max_points=5000)
    selection, chosen = select(point_filter, frames, expected_frames=announced)
    assert sum(len(points.indices) for points in chosen) == selection.num_points == 5000
    for again, before in zip(select(point_filter, frames, expected_frames=announced, seed=1)[1], chosen, strict=True):
        np.testing.assert_array_equal(again.indices, before.indices)


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
    confidence = np.concatenate([c.reshape(-1) for _, c, _ in frames])
    selection, chosen = select(PointFilter(40, edge_threshold=None, max_points=None), frames)
    kept = np.concatenate([c.reshape(-1)[p.indices] for (_, c, _), p in zip(frames, chosen, strict=True)])
    assert len(kept) == selection.num_points
    assert abs(len(kept) / len(confidence) - 0.6) < 0.01
    # To the 11 bits that files keep.
    assert kept.min() >= np.quantile(confidence, 0.4) * (1 - 2**-11)


def test_equal_confidences_are_all_kept() -> None:
    ones = np.ones((4, 5), np.float32)
    frames = [(ones, ones, np.zeros((4, 5, 3), np.uint8))] * 2
    selection, chosen = select(PointFilter(50, max_points=None), frames)
    assert selection.num_points == sum(len(points.indices) for points in chosen) == 40


@pytest.mark.parametrize("limit", [1, 100, 1234, 10**6])
def test_thinning_gives_the_announced_number_evenly(limit: int) -> None:
    frames = random_frames()
    point_filter = PointFilter(10, max_points=limit)
    selection, chosen = select(point_filter, frames)
    counts = [len(points.indices) for points in chosen]
    assert sum(counts) == selection.num_points == min(limit, selection.num_qualified)
    if limit == 1234:
        assert max(counts) - min(counts) < 0.1 * max(counts)
    for (depth, confidence, image), points in zip(frames, chosen, strict=True):
        assert (np.diff(points.indices) > 0).all()
        np.testing.assert_array_equal(points.depth, depth.reshape(-1)[points.indices])
        np.testing.assert_array_equal(points.colours, image.reshape(-1, 3)[points.indices])
        assert confidence.reshape(-1)[points.indices].min(initial=9) >= np.quantile(confidence, 0.08)
        np.testing.assert_array_equal(points.confidence, confidence.reshape(-1)[points.indices].astype(np.float16))
    for again, before in zip(select(point_filter, frames, seed=1)[1], chosen, strict=True):
        np.testing.assert_array_equal(again.indices, before.indices)


def test_frames_are_read_again_only_where_their_sample_is_too_small() -> None:
    """A quarter of the frames holds every candidate: four times the points of a mean frame, twice its sample."""
    frames = random_frames(40)
    for depth, _, _ in frames[:30]:
        depth[:] = 0
    selection = PointSelection(PointFilter(0, edge_threshold=None, max_points=4000), 40)
    read: list[int] = []
    for index, frame in enumerate(frames):
        selection.see(index, *frame)
    chosen = [selection.choose(index, lambda i=index: read.append(i) or frames[i]) for index in range(40)]
    assert [len(points.indices) for points in chosen] == [0] * 30 + [400] * 10
    assert read == list(range(30, 40))


def test_points_of_a_sample_are_those_of_the_whole_frame() -> None:
    frames = random_frames(20)
    point_filter = PointFilter(25, max_points=2000)

    def refuse() -> tuple:
        raise AssertionError("read again")

    selection, _ = select(point_filter, frames, expected_frames=20)
    sampled = [selection.choose(index, refuse) for index in range(20)]
    # Samples of 64 hold no hundred points.
    _, whole = select(point_filter, frames, expected_frames=None)
    assert sum(len(points.indices) for points in sampled) == sum(len(points.indices) for points in whole) == 2000
    for one, other in zip(sampled, whole, strict=True):
        # Samples say a little else of how many points a frame should have, and nothing of which come first.
        few, many = sorted((set(one.indices.tolist()), set(other.indices.tolist())), key=len)
        assert few <= many and len(few) > 0.7 * len(many)


def test_which_pixels_are_chosen_is_left_to_chance() -> None:
    """Every pixel of the picture is as likely, and frames of the same depth give different pixels."""
    ones, image = np.ones((24, 32), np.float32), np.zeros((24, 32, 3), np.uint8)
    _, chosen = select(PointFilter(0, max_points=76 * 100), [(ones, ones, image)] * 100, expected_frames=100)
    counts = np.bincount(np.concatenate([points.indices for points in chosen]), minlength=768)
    assert counts.sum() == 7600 and counts.max() < 30
    assert np.abs(counts.reshape(4, -1).sum(1) - 1900).max() < 200
    assert len({points.indices.tobytes() for points in chosen}) > 90


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


@pytest.mark.parametrize("lowest", [-0.0, -1.0, 0.0])
def test_confidences_of_nothing_and_less_are_the_lowest(lowest: float) -> None:
    confidence = np.full((4, 5), 2.0, np.float32)
    confidence[0] = lowest
    frames = [(np.ones((4, 5), np.float32), confidence, np.zeros((4, 5, 3), np.uint8))]
    _, chosen = select(PointFilter(25, max_points=None), frames)
    assert chosen[0].indices.tolist() == list(range(5, 20))


def test_nothing_valid_gives_no_points() -> None:
    frames = [(np.zeros((4, 5), np.float32), np.ones((4, 5), np.float32), np.zeros((4, 5, 3), np.uint8))]
    selection, chosen = select(PointFilter(), frames)
    assert selection.num_points == 0
    assert chosen[0].indices.size == 0


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
