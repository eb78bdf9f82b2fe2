"""Procedural rooms: determinism, exact geometry, paths that keep clear, textures that belong to surfaces."""

import numpy as np
import pytest

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.rooms import rooms as rooms_module
from logvggt_jax.data.rooms.layout import CLEARANCE, STYLES
from logvggt_jax.data.rooms.ray_caster import _cast
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.geometry import camera_centres, project, rotation_angle, unproject

SMALL = {"height": 42, "width": 56, "num_frames": 24, "num_rooms": 6}


def warp(frames, source: int, target: int):
    """Pixels of `source` seen in `target`: index of each in both (flat), and its depth in `target`."""
    height, width = frames.depth.shape[1:]
    depth, intrinsics, extrinsics = (a.astype(np.float64) for a in (frames.depth, frames.intrinsics, frames.extrinsics))
    points = unproject(depth[source], intrinsics[source], extrinsics[source]).reshape(-1, 3)
    pixels, z = project(points, intrinsics[target], extrinsics[target])
    u, v = np.rint(pixels).T
    inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.flatnonzero(inside), (v * width + u)[inside].astype(int), z[inside]


def test_the_same_options_give_the_same_bytes_whichever_frames_are_asked_for():
    first = Rooms("train", **SMALL)
    whole = first.read("room-00003", range(24))
    rooms_module._room.cache_clear()
    second = Rooms("train", **SMALL)
    for order in ([5], [23, 0, 5], [5, 5]):
        part = second.read("room-00003", order)
        for name in ("images", "depth", "intrinsics", "extrinsics"):
            assert np.array_equal(getattr(part, name), getattr(whole, name)[order]), name
    check_frames(whole, "rooms")
    other = Rooms("train", **SMALL, seed=1).read("room-00003", range(24))
    assert not np.array_equal(other.images, whole.images)


def test_a_room_does_not_depend_on_how_many_there_are_or_which_split_names_it():
    few, everything = Rooms("val", **SMALL), Rooms("all", **{**SMALL, "num_rooms": 20})
    name = few.sequences[2]
    assert np.array_equal(few.read(name, [7]).images, everything.read(name, [7]).images)


def test_splits_are_disjoint_and_all_is_their_union():
    splits = {name: set(Rooms(name).sequences) for name in ("train", "val", "test", "all")}
    assert [len(splits[name]) for name in ("train", "val", "test")] == [1500, 32, 32]
    assert splits["train"] | splits["val"] | splits["test"] == splits["all"]
    assert len(splits["all"]) == 1564
    assert all(len(Rooms(name).sequences) == len(splits[name]) for name in splits)


@pytest.mark.parametrize("style", STYLES)
def test_depth_lies_on_surfaces_and_nothing_stands_before_it(style: str):
    rooms = Rooms("train", **SMALL, style=style)
    for name in rooms.sequences[:4]:
        room, frames = rooms.room(name), rooms.read(name, range(0, 24, 5))
        points = unproject(*(a.astype(np.float64) for a in (frames.depth, frames.intrinsics, frames.extrinsics)))
        centres = camera_centres(frames.extrinsics.astype(np.float64))[:, None, None]
        to_walls = (room.half_size - np.abs(points)).min(-1)
        to_furniture = room.clearance(points.reshape(-1, 3)).reshape(to_walls.shape)
        assert to_walls.min() > -1e-4 and np.minimum(np.abs(to_walls), to_furniture).max() < 1e-3
        assert (to_furniture < 1e-3).mean() > 0.005
        for fraction in (0.2, 0.5, 0.8, 0.95, 0.99):
            between = (centres + fraction * (points - centres)).reshape(-1, 3)
            assert (room.clearance(between) > 0).all()


@pytest.mark.parametrize("style", STYLES)
def test_warped_depth_agrees_within_one_percent(style: str):
    rooms = Rooms("test", style=style, num_frames=12, num_rooms=4)
    for name in rooms.sequences:
        frames = rooms.read(name, range(12))
        for target in (2, 5, 10):
            _, seen, z = warp(frames, 0, target)
            error = np.abs(frames.depth[target].ravel()[seen] - z) / z
            assert len(seen) > 0.1 * frames.depth[0].size
            # Pixels hidden in the target are among `seen`, so the median is over nearly all co-visible ones.
            assert np.median(error) < 0.01 and (error < 0.05).mean() > 0.8


def test_pixels_are_given_to_the_surface_that_their_points_lie_on():
    rooms = Rooms("train", **SMALL, style="random")
    seen = set()
    for name in rooms.sequences:
        room = rooms.room(name)
        intrinsics, extrinsics = (a.astype(np.float64) for a in rooms.cameras(name, [0, 6, 12, 18]))
        for matrix, pose in zip(intrinsics, extrinsics, strict=True):
            view = _cast(room, pose, matrix, 42, 56)
            points = unproject(view.depth.astype(np.float64), matrix, pose)
            for surface in np.unique(view.surface):
                body, face = divmod(int(surface), 6)
                axis, side = face // 2, 2 * (face % 2) - 1
                on = points[view.surface == surface]
                if body == 0:
                    kind, error = f"room face {face}", on[:, axis] - side * room.half_size[axis]
                elif body <= len(room.box_centres):
                    offset, yaw = on - room.box_centres[body - 1], room.box_yaws[body - 1]
                    turn = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
                    half = room.box_half_sizes[body - 1]
                    kind, error = f"box face {face}", (offset @ turn.T)[:, axis] - side * half[axis]
                elif (index := int(surface) - 6 - 6 * len(room.box_centres)) < len(room.sphere_centres):
                    offset = np.linalg.norm(on - room.sphere_centres[index], axis=1)
                    kind, error = "sphere", offset - room.sphere_radii[index]
                else:
                    index, cap = divmod(index - len(room.sphere_centres), 2)
                    offset = on - room.cylinder_centres[index]
                    height = np.abs(offset[:, 1]) - room.cylinder_half_heights[index]
                    radial = np.hypot(offset[:, 0], offset[:, 2]) - room.cylinder_radii[index]
                    kind, error = ("cap", height) if cap else ("side", radial)
                seen.add(kind)
                assert np.abs(error).max() < 1e-3, kind
    # A box's bottom stands on the floor, where no camera sees it.
    assert seen == {f"room face {i}" for i in range(6)} | {f"box face {i}" for i in range(6) if i != 3} | {
        "sphere",
        "cap",
        "side",
    }


def test_textures_stay_on_surfaces_when_the_camera_moves():
    rooms = Rooms("test", num_frames=12, num_rooms=4)
    for name in rooms.sequences:
        frames = rooms.read(name, range(12))
        here, there, z = warp(frames, 0, 6)
        visible = np.abs(frames.depth[6].ravel()[there] - z) < 0.02 * z
        colours = frames.images.reshape(12, -1, 3).astype(np.float64)
        moved = np.abs(colours[0][here] - colours[6][there]).mean(1)[visible]
        unmoved = np.abs(colours[0] - colours[6]).mean(1)
        assert np.median(moved) < 0.5 * np.median(unmoved) and frames.images.std((1, 2)).min() > 5


@pytest.mark.parametrize("style", STYLES)
def test_cameras_keep_clear_of_furniture_and_walls(style: str):
    rooms = Rooms("all", style=style, num_frames=10_000, num_rooms=15, speed=(0.5, 1.7))
    for name in rooms.sequences:
        room = rooms.room(name)
        _, extrinsics = rooms.cameras(name, range(0, 10_000, 7))
        centres = camera_centres(extrinsics.astype(np.float64))
        assert room.clearance(centres).min() > CLEARANCE - 0.05
        assert (np.abs(centres) < room.half_size - 0.2).all()


def test_paths_are_smooth_closed_and_half_of_them_turn_all_the_way_round():
    rooms = Rooms("train", num_frames=193, num_rooms=40)
    turning = 0
    for name in rooms.sequences:
        intrinsics, extrinsics = rooms.cameras(name, range(193))
        np.testing.assert_allclose(extrinsics[96:], extrinsics[:97], atol=2e-6)
        steps = np.linalg.norm(np.diff(camera_centres(extrinsics), axis=0), axis=1)
        angles = np.rad2deg(rotation_angle(extrinsics[1:, :3, :3], extrinsics[:-1, :3, :3]))
        assert 0.005 < steps.mean() < 0.15 and steps.max() < 0.25 and angles.max() < 8
        assert (intrinsics[:, :2, 2] == [64, 48]).all()
        turning += np.rad2deg(rotation_angle(extrinsics[:, :3, :3], extrinsics[:1, :3, :3])).max() > 165
    assert 10 <= turning <= 30


def test_speed_scales_the_motion():
    slow = Rooms("val", num_frames=40, num_rooms=1, speed=0.5)
    fast = Rooms("val", num_frames=40, num_rooms=1, speed=1.0)
    name = slow.sequences[0]
    assert np.array_equal(slow.cameras(name, range(0, 40, 2))[1], fast.cameras(name, range(20))[1])


def test_only_compass_rooms_share_their_wall_colours():
    spread = {}
    for style in STYLES:
        rooms = Rooms("train", **{**SMALL, "num_rooms": 20}, style=style)
        walls = np.stack([rooms.room(name).textures.colour[0, :, :6] for name in rooms.sequences])
        spread[style] = np.ptp(walls, axis=0).max()
    assert spread["compass"] < 0.17 and spread["random"] > 0.5


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"split": "trian"}, "trian"),
        ({"style": "gothic"}, "gothic"),
        ({"height": 0}, "height"),
        ({"num_rooms": 0}, "num_rooms"),
        ({"seed": -1}, "seed"),
        ({"speed": (2.0, 1.0)}, "speed"),
        ({"speed": np.inf}, "speed"),
    ],
)
def test_bad_options_are_named(options: dict, named: str):
    with pytest.raises(ValueError, match=named):
        Rooms(**options)


def test_unknown_rooms_and_frames_are_named():
    rooms = Rooms("val", **SMALL)
    with pytest.raises(KeyError, match="room-00000"):
        rooms.read("room-00000", [0])
    for indices in ([24], [-1], []):
        with pytest.raises(IndexError, match="room-00008"):
            rooms.read("room-00008", indices)


def test_rooms_that_face_north_swing_about_one_wall():
    names = Rooms("train", **SMALL).sequences

    def widest(share: float) -> np.ndarray:
        """Largest angle in degrees between the camera's horizontal heading and +z, for each room."""
        rooms = Rooms("train", **{**SMALL, "num_frames": 96}, facing_north=share)
        forward = np.stack([rooms.cameras(name, range(96))[1][:, 2, :3] for name in names])
        return np.degrees(np.abs(np.arctan2(forward[..., 0], forward[..., 2]))).max(1)

    assert (widest(1.0) < 61).all() and (widest(1.0) > 50).all()
    assert 0 < (widest(0.5) < 61).mean() < 1
    # The same room otherwise, and by default the same path.
    room, facing = (Rooms("train", **SMALL, facing_north=share).room(names[0]) for share in (0.0, 1.0))
    np.testing.assert_array_equal(room.half_size, facing.half_size)
    np.testing.assert_array_equal(room.trajectory.positions(np.ones(1)), facing.trajectory.positions(np.ones(1)))
    with pytest.raises(ValueError, match="facing_north"):
        Rooms(facing_north=1.5)
