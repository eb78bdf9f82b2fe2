"""Mistakes of own recordings are told by their mend, from a camera that hardly moves; noise is none of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts import tum_recording
from room_views import frames_of, room_views
from scipy.spatial.transform import Rotation

from logvggt_jax.data.checks.check import INCONSISTENT, check_copy
from logvggt_jax.data.checks.mistakes import figures, mend
from logvggt_jax.frames import Frames

AXES = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)


def pairs() -> list[Frames]:
    """Three of frames next to each other, a few centimetres apart in a room of metres."""
    views = room_views(4)
    return [frames_of(views[start : start + 2]) for start in range(3)]


def told(changed: list[Frames]) -> str:
    return mend(np.stack([figures(each) for each in changed])) or ""


def test_a_sound_recording_needs_none():
    assert told(pairs()) == ""


def test_poses_of_the_other_direction_or_axes_are_told():
    turned = {
        "read the other way round (": lambda poses: np.linalg.inv(poses),
        "with y and z of the cameras' axes": lambda poses: AXES @ poses,
        "round and y and z of": lambda poses: np.linalg.inv(AXES @ poses),
    }

    def w_first(poses: np.ndarray) -> np.ndarray:
        """As if w x y z of camera-to-world rotations were read as x y z w."""
        read = Rotation.from_quat(np.roll(Rotation.from_matrix(poses[:, :3, :3]).inv().as_quat(), 1, axis=1)).inv()
        centres = np.linalg.inv(poses)[:, :3, 3]
        moved = np.tile(np.eye(4, dtype=np.float32), (len(poses), 1, 1))
        moved[:, :3, :3], moved[:, :3, 3] = read.as_matrix(), -read.apply(centres)
        return moved

    turned["first number of the poses' quaternions"] = w_first
    for words, turn in turned.items():
        assert words in told([each._replace(extrinsics=turn(each.extrinsics)) for each in pairs()])


@pytest.mark.parametrize(
    ("factor", "words"), [(2.0, "divided by about 2"), (20.0, "divided by about "), (0.5, "multiplied by about 2")]
)
def test_depth_of_another_unit_than_the_poses_is_told(factor: float, words: str):
    views = [each._replace(extrinsics=each.extrinsics.copy()) for each in pairs()]
    for each in views:
        each.extrinsics[:, :3, 3] /= factor
    assert f"with depth {words}" in told(views)
    if factor > 1:  # the figure alone would let it pass
        assert max(figures(each)[0] for each in views) < INCONSISTENT


def test_noise_of_depth_or_poses_needs_none():
    rng = np.random.default_rng(0)
    noisy = [e._replace(depth=e.depth * rng.normal(1, 0.05, e.depth.shape).astype(np.float32)) for e in pairs()]
    assert told(noisy) == ""
    for each in (jumping := pairs()):
        each.extrinsics[:, :3, 3] += rng.normal(0, 0.03, (2, 3))
    assert told(jumping) == ""


def test_of_one_pair_jumping_poses_look_like_another_unit_and_are_not_told():
    alone = pairs()[0]
    alone.extrinsics[1, :3, 3] = alone.extrinsics[0, :3, 3] + 3 * (alone.extrinsics[1] - alone.extrinsics[0])[:3, 3]
    assert told([alone]) == "" and told([alone] * 3) != ""


def test_the_check_says_what_would_mend_a_recording(tmp_path: Path):
    tum_recording.write(tmp_path, [replace(each, depth=2 * each.depth) for each in room_views(5)])
    (problem,) = check_copy("tum_recording", tmp_path).problems
    assert problem.kind == "inconsistent depth and poses" and "(it would by " in problem.message
    assert "with depth divided by about 2): " in problem.message
