"""What makes rooms harder: each option does what it says, and none of them changes rooms without it."""

import numpy as np
import pytest

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.rooms import ray_caster
from logvggt_jax.data.rooms.layout import CLEARANCE, STYLES
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.geometry import camera_centres, rotation_angle, unproject

SMALL = {"height": 42, "width": 56, "num_frames": 60, "num_rooms": 4}
HOUSE = {"rooms": 3, "period": 240, "num_frames": 240}
DRIFT = 0.06


def centres(rooms: Rooms, name: str, indices: range) -> np.ndarray:
    return camera_centres(rooms.cameras(name, indices)[1].astype(np.float64))


def test_options_that_add_nothing_are_not_part_of_the_identity() -> None:
    plain = Rooms("train", **SMALL)
    assert "clutter" not in plain.identity and plain.identity == Rooms("train", **SMALL, laps=1, exposure=0).identity
    options = {"repetition": 0.5, "lights": 1, "clutter": 2, "rooms": 2, "laps": 2, "motion_blur": 0.5, "exposure": 1.0}
    for name, value in options.items():
        changed = Rooms("val", **SMALL, **{name: value})
        assert changed.identity == {**plain.identity, name: value}
        assert changed.training_split().identity == changed.identity


@pytest.mark.parametrize("style", STYLES)
def test_cameras_walk_through_all_rooms_and_keep_clear(style: str) -> None:
    rooms = Rooms("train", **{**SMALL, **HOUSE, "num_frames": 720}, style=style, laps=3, clutter=12)
    for name in rooms.sequences:
        room, places = rooms.room(name), centres(rooms, name, range(720))
        assert room.clearance(places).min() > CLEARANCE - 0.05
        assert (np.abs(places) < room.half_size - 0.2).all()
        visited = np.floor((places[:240, 0] + room.half_size[0]) / (2 * room.half_size[0] / 3)).astype(int)
        changes = visited[np.flatnonzero(np.diff(visited)) + 1].tolist()
        # There and back, wherever it begins.
        assert sorted(changes) == [0, 1, 1, 2] and np.abs(np.diff(visited)).max() == 1
        turns = rooms.cameras(name, range(720))[1][:, :3, :3]
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.25
        assert np.rad2deg(rotation_angle(turns[1:], turns[:-1])).max() < 18


def test_partitions_have_doors_that_one_sees_through() -> None:
    rooms = Rooms("train", **{**SMALL, **HOUSE}, lights=1)
    through = 0
    for name in rooms.sequences:
        room, frames = rooms.room(name), rooms.read(name, range(0, 240, 24))
        check_frames(frames, name)
        points = unproject(*(a.astype(np.float64) for a in (frames.depth, frames.intrinsics, frames.extrinsics)))
        to_walls = (room.half_size - np.abs(points)).min(-1)
        to_things = room.clearance(points.reshape(-1, 3)).reshape(to_walls.shape)
        assert to_walls.min() > -2e-4 and np.minimum(np.abs(to_walls), to_things).max() < 2e-3
        starts = camera_centres(frames.extrinsics.astype(np.float64))[:, None, None]
        for fraction in (0.3, 0.7, 0.95):
            between = (starts + fraction * (points - starts)).reshape(-1, 3)
            assert (room.clearance(between) > 0).all()
        width = 2 * room.half_size[0] / 3
        through += (np.floor(points[..., 0] / width + 1.5) != np.floor(starts[..., 0] / width + 1.5)).sum()
    assert through > 1000


def test_laps_differ_and_the_last_ends_where_the_first_began() -> None:
    rooms = Rooms("train", **{**SMALL, "num_frames": 145}, period=48, laps=3)
    for name in rooms.sequences:
        _, poses = rooms.cameras(name, range(145))
        np.testing.assert_allclose(poses[144], poses[0], atol=1e-5)
        places = camera_centres(poses.astype(np.float64))
        aside = np.linalg.norm(places[48:96] - places[:48], axis=1)
        assert 0.005 < aside.max() < 4 * DRIFT
        forward = poses[:, 2, :3]
        assert np.degrees(np.arccos((forward[48:96] * forward[:48]).sum(1).clip(-1, 1))).max() > 5


def test_lamps_cast_shadows() -> None:
    rooms = Rooms("train", **SMALL, lights=1)
    shaded = []
    for name in rooms.sequences:
        room, frames = rooms.room(name), rooms.read(name, [0, 30])
        points = unproject(*(a.astype(np.float64) for a in (frames.depth, frames.intrinsics, frames.extrinsics)))
        # Every fourth pixel.
        points, lamp = points.reshape(-1, 3)[::4], room.lights[0, :3]
        assert room.clearance(lamp[None]) > 0 and lamp[1] < -0.5 * room.half_size[1]
        # A little off the surface, and through everything that stands before the lamp.
        start = points + 0.01 * (lamp - points)
        hidden = ray_caster._hidden(room, list(start.T.astype(np.float32)), list((lamp - start).T.astype(np.float32)))
        clearance = [room.clearance(start + fraction * (lamp - start)) for fraction in np.linspace(0.0, 1.0, 400)]
        blocked = np.min(clearance, axis=0) == 0
        # Samples along the way miss what it grazes.
        assert hidden[blocked].all() and (hidden & ~blocked).mean() < 0.01
        shaded.append(blocked.mean())
    assert max(shaded) > 0.05
    dark, lit = (frames.images.reshape(-1, 3)[::4][where].mean() for where in (blocked, ~blocked))
    assert dark < 0.7 * lit


def test_clutter_adds_things_within_capacity() -> None:
    few, many = (Rooms("train", **SMALL, clutter=clutter) for clutter in (0, 24))
    for name in few.sequences:
        counts = [
            np.array([len(room.box_centres), len(room.sphere_centres), len(room.cylinder_centres)])
            for room in (few.room(name), many.room(name))
        ]
        assert (counts[1] > counts[0]).all() and (counts[1] <= many.capacity).all()


def test_repeated_textures_repeat() -> None:
    rooms = Rooms("train", **SMALL, repetition=1.0)
    for name in rooms.sequences:
        frequency = rooms.room(name).textures.frequency[:, :, :6]
        first, second = frequency[4], frequency[1]
        stripes = (frequency[5] == 0).all(0)
        np.testing.assert_allclose(frequency[5][:, ~stripes], second[:, ~stripes])
        for wave, combination in zip(frequency, (first, second, first + second, first - second), strict=False):
            np.testing.assert_allclose(wave, combination, atol=1e-4)


def test_a_blurred_picture_is_the_mean_over_its_exposure() -> None:
    sharp, blurred = (Rooms("train", **SMALL, motion_blur=blur) for blur in (0.0, 0.8))
    name = sharp.sequences[1]
    expected, frames = sharp.read(name, [5, 20]), blurred.read(name, [5, 20])
    for key in ("depth", "intrinsics", "extrinsics"):
        np.testing.assert_array_equal(getattr(frames, key), getattr(expected, key))
    views, room = blurred.views(name, [5, 20]), sharp.room(name)
    for row in range(2):
        pictures = [
            ray_caster.render(room, [pose], views.intrinsics[row], 42, 56)[0].astype(float)
            for pose in views.exposures[row]
        ]
        assert len(pictures) == 5 and np.abs(np.mean(pictures, axis=0) - frames.images[row]).max() < 1.01
    assert (frames.images != expected.images).any()
    # 0.8 of the way from one frame to the next, less what the outermost of five cameras stand within it.
    way = np.linalg.norm(np.diff(camera_centres(views.exposures[0].astype(np.float64))[[0, -1]], axis=0))
    step = np.linalg.norm(np.diff(centres(sharp, name, range(5, 7)), axis=0))
    assert way == pytest.approx(0.8 * 0.8 * step, rel=0.1)


def test_exposure_changes_brightness_slowly_and_nothing_else() -> None:
    plain, exposed = (Rooms("train", **SMALL, exposure=stops) for stops in (0.0, 1.5))
    name = plain.sequences[2]
    gains = exposed.views(name, range(60)).gains
    assert (np.abs(np.log2(gains)) <= 1.5).all() and np.ptp(np.log2(gains)) > 0.5
    assert np.abs(np.diff(np.log2(gains))).max() < 1.0
    darkest = int(gains.argmin())
    expected, frames = plain.read(name, [darkest]), exposed.read(name, [darkest])
    np.testing.assert_array_equal(frames.depth, expected.depth)
    np.testing.assert_allclose(frames.images, expected.images * gains[darkest], atol=1.0)


@pytest.mark.parametrize(
    "options",
    [
        {"renderer": "cloud"},
        {"repetition": 1.5},
        {"lights": 4},
        {"clutter": -1},
        {"rooms": 0},
        {"laps": 0},
        {"motion_blur": -0.1},
        {"exposure": 5.0},
    ],
    ids=str,
)
def test_bad_options_are_named(options: dict) -> None:
    with pytest.raises(ValueError, match=f"rooms: .*{next(iter(options))}"):
        Rooms(**options)


def test_houses_and_laps_can_face_north_as_well() -> None:
    ahead, north = (
        Rooms("train", **{**SMALL, "num_frames": 400}, rooms=2, period=200, laps=2, facing_north=share)
        for share in (0.0, 1.0)
    )
    for name in north.sequences:
        forward = north.cameras(name, range(400))[1][:, 2, :3]
        # The swing to either side, and what laps differ by.
        assert np.degrees(np.abs(np.arctan2(forward[:, 0], forward[:, 2]))).max() < 60 + 31
        np.testing.assert_allclose(centres(north, name, range(9)), centres(ahead, name, range(9)), atol=1e-5)
