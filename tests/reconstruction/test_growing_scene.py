"""What is shown of a run that goes on is where its depth and cameras say, even over the sequence, and bounded."""

from __future__ import annotations

import numpy as np

from logvggt_jax.geometry import decode_poses, project
from logvggt_jax.reconstruction.viewer.growing_scene import GrowingScene
from logvggt_jax.reconstruction.watching import LiveResult
from logvggt_jax.streaming import FrameResult

SIZE = (28, 42)


def encoding(index: int) -> np.ndarray:
    """A camera at x = 2 · index, turned a little."""
    turn = np.array([0.1, 0.05, -0.02, 1.0]) / np.linalg.norm([0.1, 0.05, -0.02, 1.0])
    return np.array([-2.0 * index, 0, 0, *turn, 0.9, 1.2], np.float32)


def frame(index: int, pose: np.ndarray | None) -> LiveResult:
    """A frame whose red says the row of a pixel, green its column and blue the frame; depth grows along rows."""
    rows, columns = np.indices(SIZE)
    depth = (1 + rows / 100).astype(np.float32)
    image = np.stack([rows, columns, np.full(SIZE, index % 256)], axis=-1).astype(np.uint8)
    result = FrameResult(index, depth, np.full(SIZE, 2.0, np.float32), pose, pose is not None, None, None)
    return LiveResult(f"frame-{index}", float(index), image, SIZE, result)


def test_points_lie_where_depth_and_camera_put_them() -> None:
    scene = GrowingScene()
    for index in range(3):
        scene.add(frame(index, encoding(index)))
    found = scene.scene()
    assert found is not None and found.num_frames == 3 and found.newest_is_placed
    assert len(found.points) == 3 * SIZE[0] * SIZE[1]  # so few that all are kept
    expected = decode_poses(np.stack([encoding(index) for index in range(3)]).astype(np.float64), SIZE)
    np.testing.assert_allclose(found.extrinsics, expected[0])
    for index in range(3):
        own = found.colours[:, 2] == index
        pixels, depth = project(found.points[own].astype(np.float64), expected[1][index], expected[0][index])
        np.testing.assert_allclose(pixels, found.colours[own][:, 1::-1], atol=1e-3)
        np.testing.assert_allclose(depth, 1 + found.colours[own][:, 0] / 100, rtol=1e-5)


def test_frames_appear_when_they_have_a_pose_and_move_with_it() -> None:
    scene = GrowingScene()
    for index in range(4):
        scene.add(frame(index, None))
    assert scene.scene() is None
    scene.place(np.stack([encoding(index) for index in range(2)]))
    first = scene.scene()
    assert first is not None and set(first.colours[:, 2]) == {0, 1} and not first.newest_is_placed
    scene.place(np.stack([encoding(index + 1) for index in range(4)]))
    then = scene.scene()
    assert then is not None and set(then.colours[:, 2]) == {0, 1, 2, 3} and then.newest_is_placed
    np.testing.assert_allclose(first.extrinsics[1], then.extrinsics[0])


def test_of_a_long_run_a_bounded_number_of_points_is_kept_evenly() -> None:
    scene, most = GrowingScene(most_points=2000, most_frames=50), 0
    for index in range(1000):
        scene.add(frame(index, encoding(index)))
        if index % 20 == 0:
            found = scene.scene()
            assert found is not None
            most = max(most, len(found.points))
            assert len(found.points) <= 2000 and len(found.extrinsics) <= 51
            np.testing.assert_allclose(found.extrinsics[-1], decode_poses(encoding(index).astype(float), SIZE)[0])
    assert most > 1000
    found = scene.scene()
    assert found is not None
    places = np.sort(np.unique(-found.extrinsics[:-1, 0, 3] / 2).round())
    assert len(set(np.diff(places))) == 1 and places[0] == 0 and places[-1] >= 950
    counts = np.unique(found.colours[:, 2], return_counts=True)[1]
    assert counts.max() <= 2 * counts.min()


def test_numbers_that_are_none_are_left_out() -> None:
    scene, broken = GrowingScene(), frame(0, encoding(0))
    broken.result.depth[:10] = np.nan
    broken.result.confidence[10:12] = np.nan
    scene.add(broken)
    scene.add(frame(1, np.full(9, np.nan, np.float32)))
    found = scene.scene()
    assert found is not None and np.isfinite(found.points).all() and found.colours[:, 0].min() == 12
    assert len(found.extrinsics) == 1 and not found.newest_is_placed
