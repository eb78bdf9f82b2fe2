"""Which way is up, where a scene is looked at from, which points are shown and in which colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from result_folder import write_result

from logvggt_jax.colours import depth_picture
from logvggt_jax.reconstruction.points.cloud_file import Cloud
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.up_direction import up_direction
from logvggt_jax.reconstruction.viewer.colouring import colourings, level_limits, palette, point_colours, point_levels
from logvggt_jax.reconstruction.viewer.detail import Detail, levels_of_detail
from logvggt_jax.reconstruction.viewer.opening_view import opening_view, point_spacing, scene_span


def test_of_twenty_million_points_two_are_shown_evenly() -> None:
    count = 20_000_000
    nothing = np.broadcast_to(np.zeros(3, np.float32), (count, 3))
    detail = Detail(Cloud(nothing, np.broadcast_to(np.uint8(0), (count, 3)), None, None))
    assert levels_of_detail(count)[0] == 2_000_000
    chosen = detail.choose(2_000_000)
    tenths = np.bincount(chosen // (count // 10), minlength=10)
    assert len(chosen) == 2_000_000 and abs(tenths / 200_000 - 1).max() < 0.01
    np.testing.assert_array_equal(detail.choose(500_000), chosen[:500_000])


def turned(axis: int, angle: float) -> np.ndarray:
    """A rotation [3, 3] about an axis."""
    first, second = [each for each in range(3) if each != axis]
    made = np.eye(3)
    made[[first, second], [first, second]] = np.cos(angle)
    made[first, second], made[second, first] = -np.sin(angle), np.sin(angle)
    return made


def cameras(headings: np.ndarray, pitch: float, world: np.ndarray) -> np.ndarray:
    """Level cameras [N, 3, 4] that look around and down, in a world whose axes are turned."""
    rotations = [turned(0, pitch) @ turned(1, heading) @ world for heading in headings]
    return np.concatenate([np.stack(rotations), np.zeros((len(rotations), 3, 1))], axis=2)


def test_up_is_across_the_horizontals_of_cameras_that_look_down() -> None:
    world = turned(0, 0.7) @ turned(2, 0.4)
    for pitch in (0.0, 0.6, -0.5):
        extrinsics = cameras(np.linspace(0, 2, 20), pitch, world)
        np.testing.assert_allclose(up_direction(extrinsics), -world[1], atol=1e-6)


def test_up_of_cameras_that_do_not_turn_is_their_own() -> None:
    extrinsics = cameras(np.linspace(0, 0.01, 5), 0.3, np.eye(3))
    assert up_direction(extrinsics) @ -extrinsics[0, 1, :3] > 0.9999
    rolled = np.stack([np.eye(4)[:3], np.diag([-1.0, -1, 1, 1])[:3]])
    np.testing.assert_allclose(up_direction(rolled), [0, -1, 0])


def test_the_opening_view_looks_as_the_first_camera_and_shows_nine_tenths() -> None:
    generator = np.random.default_rng(0)
    extrinsics = np.tile(np.eye(4)[:3], (2, 1, 1))
    extrinsics[:, :, 3] = [[-5, 1, 2], [0, 0, 0]]
    intrinsics = np.tile(np.diag([100.0, 100, 1]), (2, 1, 1))
    points = generator.uniform((0, -6, 3), (10, 4, 6), (5000, 3))
    points[:20] = 1e6  # a few that are far off count for nothing
    view = opening_view(extrinsics, intrinsics, (100, 100), points)
    np.testing.assert_allclose(view.up, [0, -1, 0])
    assert view.position[:2].tolist() == [5, -1] and view.position[2] < -2 and view.target[2] > 3
    away = points - view.position
    seen = np.abs(away[:, :2]).max(1) < np.tan(view.field_of_view / 2) * away[:, 2]
    assert 0.89 < seen.mean() < 0.92


@pytest.mark.parametrize("points", [np.zeros((0, 3), np.float32), np.full((5, 3), -9, np.float32)])
def test_there_is_a_view_where_nothing_is_to_be_seen(points: np.ndarray) -> None:
    extrinsics, intrinsics = np.eye(4)[None, :3], np.diag([100.0, 100, 1])[None]
    view = opening_view(extrinsics, intrinsics, (100, 100), points)
    np.testing.assert_allclose([*view.position, *view.target], [0, 0, 0, 0, 0, 1])
    assert scene_span(points, np.zeros((1, 3))) > 0 and point_spacing(1.0, 0) > 0


def test_the_span_of_a_scene_is_not_that_of_its_stray_points() -> None:
    points = np.random.default_rng(0).uniform(0, 2, (1000, 3))
    points[:10] = 1e9
    assert 1.8 < scene_span(points, np.zeros((1, 3))) < 2.1
    assert scene_span(points, np.array([[0, 0, 0], [0, 7.0, 0]])) == 7


def cloud(count: int, frames: int) -> Cloud:
    """A cloud on a line, whose confidence rises along it."""
    points = np.zeros((count, 3), np.float32)
    points[:, 2] = np.linspace(1, 5, count)
    frame = np.arange(count, dtype=np.int32) * frames // count
    return Cloud(points, np.full((count, 3), 9, np.uint8), np.linspace(1, 100, count, dtype=np.float32), frame)


def test_more_detail_shows_what_less_shows_and_is_even() -> None:
    detail = Detail(cloud(10_000, 10))
    few, many = detail.choose(1000), detail.choose(3000)
    assert len(set(many.tolist())) == 3000 and set(few.tolist()) < set(many.tolist())
    counts = np.bincount(few // 1000, minlength=10)
    assert counts.min() > 70 and counts.max() < 130
    assert len(detail.choose(10**6)) == 10_000


def test_what_is_chosen_is_sure_enough_and_of_the_frame() -> None:
    made = cloud(10_000, 10)
    assert made.confidence is not None and made.frame is not None
    detail = Detail(made)
    lowest = detail.confidence_at(60)
    chosen = detail.choose(2000, lowest=lowest)
    assert len(chosen) == 2000 and made.confidence[chosen].min() >= lowest
    assert abs(len(detail.choose(10**6, lowest=lowest)) - 4000) <= 1
    alone = detail.choose(10**6, frame=7)
    assert sorted(alone.tolist()) == np.flatnonzero(made.frame == 7).tolist()
    assert set(detail.choose(10, frame=7).tolist()) < set(alone.tolist())
    assert len(detail.choose(10**6, frame=0, lowest=lowest)) == 0


def test_a_cloud_without_confidence_and_frame_is_shown_in_its_own_colours(tmp_path: Path) -> None:
    write_result(tmp_path)
    old = cloud(100, 3)._replace(confidence=None, frame=None)
    assert colourings(old) == ("image",)
    detail = Detail(old)
    assert len(detail.choose(50, lowest=5.0, frame=1)) == 50 and detail.confidence_at(50) == 0
    colours = point_colours("image", old, detail.choose(4), Reconstruction.open(tmp_path), (1.0, 2.0))
    assert colours.tolist() == [[9, 9, 9]] * 4


def test_colours_say_depth_confidence_and_time(tmp_path: Path) -> None:
    write_result(tmp_path)
    result, made = Reconstruction.open(tmp_path), cloud(999, 3)
    everything = np.arange(999)
    for colouring in ("depth", "confidence", "time"):
        limits = level_limits(colouring, made, everything, result)
        levels = point_levels(colouring, made, everything, result, limits)
        rising = levels[::-1] if colouring == "depth" else levels
        assert (np.diff(rising) >= 0).all() and rising[0] == 0 and rising[-1] == 1
        shown = point_colours(colouring, made, everything, result, limits)
        np.testing.assert_array_equal(shown[[levels.argmin(), levels.argmax()]], palette(colouring)[[0, -1]])
    # The cameras look along z: a point's depth is its z, and levels are even in its inverse.
    limits = (1.0, 5.0)
    levels = point_levels("depth", made, np.array([0, 998]), result, limits)
    assert levels.tolist() == [1, 0]
    middle = point_levels("depth", made, np.array([499]), result, limits)
    np.testing.assert_allclose(middle, (1 / 3 - 1 / 5) / (1 - 1 / 5))


def test_near_is_yellow_and_far_is_violet_and_neither_is_the_black_of_no_depth() -> None:
    shown = depth_picture(np.array([[1.0, 4.0, 0.0]]), near=1.0, far=4.0)
    assert shown.tolist() == [[[253, 231, 37], [68, 1, 84], [0, 0, 0]]]
