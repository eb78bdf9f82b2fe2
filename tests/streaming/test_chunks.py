"""Chains of chunks: a predictor whose every chunk has a world and unit of its own, and the similarity known."""

from __future__ import annotations

import weakref

import numpy as np
import pytest

from logvggt_jax.geometry import Similarity, compose, quaternion_to_matrix, relative_to_first, umeyama, unproject
from logvggt_jax.streaming.chunks import ChunkChain, ChunkPlan, align, move
from logvggt_jax.streaming.offline import PlainPrediction

FRAMES, HEIGHT, WIDTH = 23, 12, 16


@pytest.fixture(scope="module")
def truth() -> PlainPrediction:
    """A sequence with random depth and poses; the world is the first camera."""
    generator = np.random.default_rng(0)
    rotation = quaternion_to_matrix(generator.normal(size=(FRAMES, 4)) * 0.2 + [0, 0, 0, 1])
    poses = np.concatenate([rotation, generator.normal(size=(FRAMES, 3, 1))], axis=2)
    intrinsics = np.tile(np.array([[14.0, 0, 8], [0, 13.0, 6], [0, 0, 1]]), (FRAMES, 1, 1))
    return PlainPrediction(
        depth=generator.uniform(1.0, 5.0, (FRAMES, HEIGHT, WIDTH)).astype(np.float32),
        depth_confidence=1 + generator.uniform(0.0, 4.0, (FRAMES, HEIGHT, WIDTH)).astype(np.float32),
        extrinsics=relative_to_first(poses)[:, :3].astype(np.float32),
        intrinsics=intrinsics.astype(np.float32),
    )


def images() -> list[np.ndarray]:
    """Frames that carry their own number."""
    return [np.full((HEIGHT, WIDTH, 3), index, np.uint8) for index in range(FRAMES)]


class Oracle:
    """Knows a frame by its number; a chunk comes in its first camera's frame and in a random unit."""

    def __init__(self, truth: PlainPrediction) -> None:
        self.truth = truth
        self.chunks: list[list[int]] = []
        self.generator = np.random.default_rng(1)

    def __call__(self, chunk: np.ndarray) -> PlainPrediction:
        numbers = chunk[:, 0, 0, 0].tolist()
        self.chunks.append(numbers)
        unit = 1.0 if len(self.chunks) == 1 else self.generator.uniform(0.3, 3.0)
        poses = relative_to_first(compose(self.truth.extrinsics[numbers], np.eye(4)).astype(np.float64))
        poses[:, :3, 3] *= unit
        return PlainPrediction(
            depth=unit * self.truth.depth[numbers],
            depth_confidence=self.truth.depth_confidence[numbers],
            extrinsics=poses[:, :3],
            intrinsics=self.truth.intrinsics[numbers],
        )


def run(predict: Oracle, plan: ChunkPlan, count: int = FRAMES) -> PlainPrediction:
    chain = ChunkChain(predict, plan)
    parts = [part for image in images()[:count] if (part := chain.push(image)) is not None]
    last = chain.close()
    assert last is not None
    fields = zip(*(part[:4] for part in (*parts, last)), strict=True)
    return PlainPrediction(*(np.concatenate(field) for field in fields))


@pytest.mark.parametrize(("size", "overlap"), [(8, 4), (7, 1), (9, 6), (22, 3), (23, 11), (40, 5)])
def test_chain_recovers_poses_and_the_scale_of_depth(truth: PlainPrediction, size: int, overlap: int) -> None:
    predict = Oracle(truth)
    result = run(predict, ChunkPlan(size, overlap))
    np.testing.assert_allclose(result.depth, truth.depth, rtol=1e-4)
    np.testing.assert_allclose(result.extrinsics, truth.extrinsics, atol=2e-4)
    np.testing.assert_array_equal(result.depth_confidence, truth.depth_confidence)
    expected = [list(range(start, stop)) for start, stop in ChunkPlan(size, overlap).ranges(FRAMES)]
    assert predict.chunks == expected


@pytest.mark.parametrize("count", range(1, 16))
def test_every_length_gives_every_frame_once(truth: PlainPrediction, count: int) -> None:
    predict = Oracle(truth)
    result = run(predict, ChunkPlan(6, 2), count)
    np.testing.assert_allclose(result.depth, truth.depth[:count], rtol=1e-4)
    assert predict.chunks == [list(range(*bounds)) for bounds in ChunkPlan(6, 2).ranges(count)]


def test_wrong_pixels_move_the_similarity_little(truth: PlainPrediction) -> None:
    target = PlainPrediction(*(x[:6] for x in truth[:4]))
    wrong = np.random.default_rng(2).random(target.depth.shape) < 0.1
    source = target._replace(depth=np.where(wrong, 3 * target.depth, target.depth))
    points = [unproject(p.depth, p.intrinsics, p.extrinsics).reshape(-1, 3) for p in (source, target)]
    plain = umeyama(*points)
    assert abs(plain.scale - 1) > 0.2
    robust = align(source, target)
    assert abs(robust.scale - 1) < 0.03
    assert np.linalg.norm(robust.translation) < 0.2 * np.linalg.norm(plain.translation)


def test_of_a_frame_in_two_chunks_the_later_counts(truth: PlainPrediction) -> None:
    """The second chunk's own error at a frame it shares is what comes out."""
    predict = Oracle(truth)

    def spoil(chunk: np.ndarray) -> PlainPrediction:
        prediction = predict(chunk)
        marked = prediction.depth_confidence.copy()
        marked[:] = len(predict.chunks)
        return prediction._replace(depth_confidence=marked)

    result = run(spoil, ChunkPlan(8, 4), 12)  # type: ignore[arg-type]
    assert result.depth_confidence[:, 0, 0].tolist() == [1] * 4 + [2] * 8


def test_alignment_uses_what_both_are_confident_of(truth: PlainPrediction) -> None:
    """Pixels that one of the two knows nothing of may hold anything."""
    target = PlainPrediction(*(x[:3] for x in truth[:4]))
    target = target._replace(depth_confidence=100 * target.depth_confidence)
    depth, confidence = target.depth.copy(), target.depth_confidence.copy()
    depth[:, :4], confidence[:, :4] = 50.0, 1.0
    depth[0, 5, 5], depth[1, 6, 6], depth[2, 7, 7] = np.nan, -1.0, 0.0
    source = target._replace(depth=depth, depth_confidence=confidence)
    similarity = align(source, target)
    assert similarity.scale == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(similarity.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(similarity.translation, 0, atol=1e-6)


def test_points_move_with_depth_and_cameras(truth: PlainPrediction) -> None:
    rotation = quaternion_to_matrix(np.array([0.1, 0.3, -0.2, 0.9]))
    similarity = Similarity(2.5, rotation, np.array([1.0, -2.0, 0.5]))
    points = unproject(truth.depth, truth.intrinsics, truth.extrinsics)
    moved = move(truth._replace(points=points), similarity)
    assert moved.points is not None
    np.testing.assert_allclose(moved.points, similarity.apply(points), rtol=1e-4, atol=1e-4)
    again = unproject(moved.depth, moved.intrinsics, moved.extrinsics)
    np.testing.assert_allclose(again, moved.points, rtol=1e-3, atol=1e-3)


def test_no_more_than_a_chunk_is_held(truth: PlainPrediction) -> None:
    plan, alive, seen = ChunkPlan(6, 2), [], []
    chain = ChunkChain(Oracle(truth), plan)
    predictions: list[weakref.ref] = []
    for image in images():
        frame = image.copy()
        seen.append(weakref.ref(frame))
        part = chain.push(frame)
        if part is not None:
            predictions.append(weakref.ref(part.depth.base if part.depth.base is not None else part.depth))
        del frame, part
        alive.append(sum(reference() is not None for reference in seen))
    assert max(alive) < plan.size
    assert not [reference for reference in predictions if reference() is not None], (
        "chunks that are handed out are gone"
    )


def test_bytes_of_a_chain_are_those_of_a_chunk_and_an_overlap(truth: PlainPrediction) -> None:
    """Pictures until their chunk is full; then the overlap's, and what was predicted of them."""
    chain, found = ChunkChain(Oracle(truth), ChunkPlan(8, 4)), []
    for image in images()[:16]:
        chain.push(image)
        found.append(chain.held_bytes)
    picture = HEIGHT * WIDTH * 3
    assert found[:7] == [n * picture for n in range(1, 8)]
    shared = 4 * (picture + 4 * (2 * HEIGHT * WIDTH + 3 * 4 + 3 * 3))
    # The first chunk is kept as it was predicted, and the stand-in's poses are of double precision.
    assert found[11::4] == [shared] * 2 and found[7] == shared + 4 * 12 * 4


def test_chunks_that_do_not_fit_are_named(truth: PlainPrediction) -> None:
    predict = Oracle(truth)

    def blind(chunk: np.ndarray) -> PlainPrediction:
        prediction = predict(chunk)
        return (
            prediction
            if len(predict.chunks) == 1
            else prediction._replace(depth=np.full_like(prediction.depth, np.nan))
        )

    with pytest.raises(ValueError, match=r"chunk from frame 4 to 9 .* on the 2 frames they share \(0 of 384 pixels"):
        run(blind, ChunkPlan(6, 2))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("size", "overlap", "message"),
    [
        (4, 4, "below the chunk size 4, got 4"),
        (1, 1, "below the chunk size 1"),
        (4, 0, "ChunkPlan.overlap must be a positive integer, got 0"),
        (0, 1, "ChunkPlan.size must be"),
        (4.0, 2, "ChunkPlan.size must be a positive integer"),
    ],
)
def test_impossible_chunks_are_named(size: int, overlap: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ChunkPlan(size, overlap)
