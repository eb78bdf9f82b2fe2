"""`check_frames` refuses what cannot be trained or evaluated on, and lets sets without poses pass only where asked."""

import numpy as np
import pytest
from analytic_room import pinhole
from room_views import frames_of, room_views

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.frames import Frames

SIZE = (12, 16)


@pytest.fixture
def frames() -> Frames:
    return frames_of(room_views(3, pinhole(SIZE, 12.0), SIZE))


def test_frames_with_poses_pass_whether_or_not_poses_are_needed(frames: Frames):
    check_frames(frames, "room")
    check_frames(frames, "room", poses=False)


def test_frames_without_any_pose_pass_only_where_poses_are_not_needed(frames: Frames):
    frames.extrinsics[:] = np.nan
    check_frames(frames, "room", poses=False)
    with pytest.raises(ValueError, match="room: extrinsics must be finite; frame 0"):
        check_frames(frames, "room")


@pytest.mark.parametrize("poses", [True, False])
def test_poses_that_are_partly_there_or_not_rigid_never_pass(frames: Frames, poses: bool):
    for place, value, complaint in (
        (1, np.nan, "finite; frame 1"),
        ((2, 0, 3), np.nan, "finite; frame 2"),
        ((0, 0, 0), 2.0, "rotations.*frame 0"),
        ((slice(None), 0, 3), np.inf, "finite; frame 0"),
    ):
        broken = frames._replace(extrinsics=frames.extrinsics.copy())
        broken.extrinsics[place] = value
        with pytest.raises(ValueError, match=f"extrinsics must.*{complaint}"):
            check_frames(broken, "room", poses=poses)


@pytest.mark.parametrize("poses", [True, False])
def test_depth_and_intrinsics_are_checked_with_and_without_poses(frames: Frames, poses: bool):
    if not poses:
        frames.extrinsics[:] = np.nan
    for name, place, value in (
        ("depth", (1, 0, 0), np.nan),
        ("depth", (1, 0, 0), -1.0),
        ("intrinsics", (1, 0, 0), 0.0),
    ):
        broken = frames._replace(**{name: getattr(frames, name).copy()})
        getattr(broken, name)[place] = value
        with pytest.raises(ValueError, match=f"{name} must.*frame 1"):
            check_frames(broken, "room", poses=poses)
