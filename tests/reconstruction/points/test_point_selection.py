"""Point clouds hold the chosen pixels' points, in the number announced, at constant memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from logvggt_jax.reconstruction.points.cloud_file import (
    VERTEX,
    count_points,
    write_points,
)
from logvggt_jax.reconstruction.points.frame_points import FramePoints
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.points.selection import PointSelection


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
