"""A candidate loop: the same place passes, whatever world and unit; places that only look alike do not."""

from __future__ import annotations

import numpy as np
import pytest

from logvggt_jax.data import open_dataset
from logvggt_jax.frames import Frames
from logvggt_jax.geometry import Similarity, quaternion_to_matrix
from logvggt_jax.streaming.alignment import move
from logvggt_jax.streaming.loop_check import check_loop
from logvggt_jax.streaming.offline import PlainPrediction

DRIFT = Similarity(1.7, quaternion_to_matrix(np.array([0.05, 0.3, -0.1, 0.9])), np.array([1.0, -0.5, 2.0]))
UNIT = Similarity(0.4, quaternion_to_matrix(np.array([0.2, -0.1, 0.1, 0.9])), np.array([-1.0, 0.5, 0.3]))


def rooms(count: int, **options: int) -> list[Frames]:
    data = open_dataset("rooms", None, split="test", num_rooms=count, height=42, width=56, period=48, **options)
    return [data.read(sequence, range(data.num_frames(sequence))) for sequence in data.sequences]


@pytest.fixture(scope="module")
def laps() -> Frames:
    """Twice round a room."""
    return rooms(1, laps=2, num_frames=96)[0]


def predicted(frames: Frames, chosen: slice) -> PlainPrediction:
    depth = frames.depth[chosen]
    confidence = np.full_like(depth, 2.0)
    return PlainPrediction(depth, confidence, frames.extrinsics[chosen, :3], frames.intrinsics[chosen])


def joined(*parts: PlainPrediction) -> PlainPrediction:
    return PlainPrediction(*(np.concatenate(fields) for fields in zip(*(part[:4] for part in parts), strict=True)))


def test_the_same_place_passes_and_the_drift_between_is_found(laps: Frames) -> None:
    first, second = predicted(laps, slice(10, 16, 2)), predicted(laps, slice(58, 64, 2))
    check = check_loop(move(joined(first, second), UNIT), first, move(second, DRIFT))
    assert check.passed
    assert check.shape > 0.99 and check.overlap > 0.4 and check.agreement > 0.9
    np.testing.assert_allclose(check.relative, np.linalg.inv(DRIFT.matrix), atol=1e-3)


def test_noise_of_the_depth_is_borne(laps: Frames) -> None:
    def noisy(prediction: PlainPrediction) -> PlainPrediction:
        noise = np.random.default_rng(0).normal(1.0, 0.02, prediction.depth.shape)
        return prediction._replace(depth=(noise * prediction.depth).astype(np.float32))

    first, second = predicted(laps, slice(10, 16, 2)), predicted(laps, slice(58, 64, 2))
    assert check_loop(noisy(joined(first, second)), first, second).passed


def test_places_that_see_other_things_are_refused(laps: Frames) -> None:
    first, second = predicted(laps, slice(0, 6, 2)), predicted(laps, slice(24, 30, 2))
    turned = Similarity(1.0, quaternion_to_matrix(np.array([0.0, 1.0, 0.0, 0.0])), np.array([20.0, 0.0, 0.0]))
    check = check_loop(joined(first, move(second, turned)), first, second)
    assert not check.passed and check.overlap == 0.0


def test_a_room_that_looks_alike_is_refused_even_where_the_model_takes_it_for_the_same() -> None:
    """Both rooms put into one world, as a fooled model does: their furniture contradicts that."""
    one, other = rooms(2, num_frames=48)
    passed = []
    for start in (12, 18, 24):  # where both look at walls of their own
        first = predicted(one, slice(start, start + 6, 2))
        for begin in range(0, 42, 6):
            second = predicted(other, slice(begin, begin + 6, 2))
            passed.append(check_loop(joined(first, second), first, second).passed)
    assert not any(passed), f"{sum(passed)} of {len(passed)}"


def test_what_the_joint_prediction_shapes_otherwise_is_refused(laps: Frames) -> None:
    first, second = predicted(laps, slice(10, 16, 2)), predicted(laps, slice(58, 64, 2))
    bent = joined(first, second)
    bent = bent._replace(depth=bent.depth * np.linspace(0.7, 1.3, bent.depth.shape[2], dtype=np.float32))
    check = check_loop(bent, first, second)
    assert not check.passed and check.shape < 0.4


def test_without_depth_there_is_no_loop(laps: Frames) -> None:
    first, second = predicted(laps, slice(10, 16, 2)), predicted(laps, slice(58, 64, 2))
    empty = joined(first, second)._replace(depth=np.full((6, 42, 56), np.nan, np.float32))
    check = check_loop(empty, first, second)
    assert not check.passed and check.relative is None
