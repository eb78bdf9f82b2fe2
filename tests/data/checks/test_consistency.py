"""The consistency figure: small where depth, intrinsics and poses belong together, large where one of them is wrong."""

from pathlib import Path

import numpy as np
import pytest
from analytic_room import disagreement, pinhole
from room_views import frames_of, room_views

from logvggt_jax.data import open_dataset
from logvggt_jax.data.checks.consistency import depth_consistency, visible_shares
from logvggt_jax.frames import Frames

SIZE = (48, 64)


@pytest.fixture
def room() -> Frames:
    return frames_of(room_views(5, pinhole(SIZE, 40.0), SIZE)[::4])


def test_true_cameras_agree_and_the_figure_is_the_independent_one(room: Frames):
    for first, second in ((0, 1), (1, 0), (0, 0)):
        result = depth_consistency(room, first, second)
        assert result == pytest.approx(disagreement(room, first, second), rel=1e-3, abs=1e-6)
        assert result.difference < 0.01 and result.share > 0.5
    assert depth_consistency(room, 0, 0) == pytest.approx((0.0, 1.0), abs=1e-6)


def test_wrong_poses_and_depth_disagree(room: Frames):
    swapped = room._replace(extrinsics=np.linalg.inv(room.extrinsics))
    forward = room._replace(extrinsics=room.extrinsics.copy())
    forward.extrinsics[1, 2, 3] += 0.5
    scaled = room._replace(depth=room.depth * np.float32([[[1.0]], [[1.3]]]))
    for broken in (swapped, forward, scaled):
        assert depth_consistency(broken, 0, 1).difference > 0.1


def test_pixels_without_depth_are_not_compared(room: Frames):
    full = depth_consistency(room, 0, 0).share
    room.depth[0, :, ::2] = 0
    assert depth_consistency(room, 0, 0).share == full == 1
    assert depth_consistency(room, 0, 1).share < 1
    room.depth[1] = 0
    difference, share = depth_consistency(room, 0, 1)
    assert np.isnan(difference) and share == 0 and depth_consistency(room, 1, 0).share == 0


def test_visible_shares_say_which_cameras_see_the_frame(room: Frames):
    behind = np.diag([-1.0, 1.0, -1.0, 1.0]).astype(np.float32) @ room.extrinsics[0]
    own, other, none = visible_shares(room, 0, np.stack([*room.extrinsics, behind]))
    assert own == 1 and 0.4 < other < 1 and none == 0
    assert other == pytest.approx(depth_consistency(room, 0, 1).share, abs=0.05)
    room.depth[0] = 0
    assert not visible_shares(room, 0, room.extrinsics).any()


def test_real_frames_have_the_figure_that_their_description_gives(seven_scenes_dir: Path):
    """redkitchen/seq-01, frames 30 apart: 9.3 mm, and 284 mm with its poses read the wrong way round."""
    scenes = open_dataset("seven_scenes", seven_scenes_dir)
    right, wrong = [], []
    for first in (100, 400, 700):
        frames = scenes.read("redkitchen/seq-01", [first, first + 30])
        metres = np.median(frames.depth[frames.depth > 0])
        right.append(metres * depth_consistency(frames, 0, 1).difference)
        swapped = frames._replace(extrinsics=np.linalg.inv(frames.extrinsics))
        wrong.append(metres * depth_consistency(swapped, 0, 1).difference)
    assert 0.006 < np.median(right) < 0.014 and 0.14 < np.median(wrong) < 0.57
