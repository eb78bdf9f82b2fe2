"""Frames of the analytic room for tests of readers to write, and the check that a reader returns them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from analytic_room import camera_to_world, disagreement, view

from logvggt_jax.data.dataset import check_frames


class RoomFrame(NamedTuple):
    pose: np.ndarray  # camera-to-world [4, 4], OpenCV, metres
    picture: np.ndarray  # [H, W, 3] uint8 RGB
    depth: np.ndarray  # [H, W] float64, metres


def room_frame(index: int, intrinsics: np.ndarray, size: tuple[int, int]) -> RoomFrame:
    pose = camera_to_world(index)
    return RoomFrame(pose, *view(pose, intrinsics, size))


def assert_shows_room(
    frames,
    poses: list[int],
    intrinsics: np.ndarray,
    *,
    depth_step: float,
    picture_error: int = 0,
    pose_error: float = 1e-5,
) -> None:
    """`frames` are the room's at these poses: pictures, depth to half a step, cameras; and they agree in 3D."""
    check_frames(frames, "room")
    assert len(frames.images) == len(poses)
    for position, index in enumerate(poses):
        pose, picture, depth = room_frame(index, intrinsics, frames.images.shape[1:3])
        difference = np.abs(frames.images[position].astype(int) - picture)
        assert difference.max() <= 4 * picture_error and difference.mean() <= picture_error
        np.testing.assert_allclose(frames.depth[position], depth, atol=0.501 * depth_step)
        np.testing.assert_allclose(frames.intrinsics[position], intrinsics, rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(frames.extrinsics[position], np.linalg.inv(pose), atol=pose_error)
    for first in range(len(poses)):
        for second in range(len(poses)):
            error, share = disagreement(frames, first, second)
            assert error < 0.008 and share > 0.4
