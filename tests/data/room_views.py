"""What tests of readers on the analytic room share: its views from a moving camera, and the comparison with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from analytic_room import camera_to_world, disagreement, view

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.frames import Frames


@dataclass(frozen=True)
class RoomView:
    """Camera-to-world [4, 4], intrinsics [3, 3], picture [H, W, 3] uint8 RGB, z-depth [H, W] float64 metres."""

    pose: np.ndarray
    intrinsics: np.ndarray
    picture: np.ndarray
    depth: np.ndarray


def room_views(count: int, intrinsics: np.ndarray, size: tuple[int, int]) -> list[RoomView]:
    """Views of the first `count` cameras of the room's path."""
    poses = [camera_to_world(index) for index in range(count)]
    return [RoomView(pose, intrinsics, *view(pose, intrinsics, size)) for pose in poses]


def check_views(
    frames: Frames, views: list[RoomView], *, picture_error: float, depth_error: float, overlap: float = 0.5
) -> None:
    """Asserts that `frames` are `views`: pictures to a mean of `picture_error` levels, depth to `depth_error` metres,
    calibration and poses to float32; and that every frame's depth, carried into the next, agrees with what is there
    over a share of at least `overlap`."""
    check_frames(frames, "the analytic room")
    assert len(frames.images) == len(views)
    for i, expected in enumerate(views):
        assert np.abs(frames.images[i].astype(float) - expected.picture).mean() <= picture_error
        np.testing.assert_allclose(frames.depth[i], expected.depth, atol=depth_error)
        np.testing.assert_allclose(frames.intrinsics[i], expected.intrinsics, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(frames.extrinsics[i], np.linalg.inv(expected.pose), atol=1e-5)
    for first in range(len(views) - 1):
        for one, other in ((first, first + 1), (first + 1, first)):
            difference, share = disagreement(frames, one, other)
            assert difference < 0.008 and share > overlap, (one, other, difference, share)
