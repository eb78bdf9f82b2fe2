"""Rooms drawn in JAX are those that numpy draws, to a grey level and 1e-4 of depth."""

import jax
import numpy as np
import pytest

from logvggt_jax.data.dataset import DrawnOnDevice
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.data.rooms.scenes import RoomScenes, pack

SMALL = {"height": 42, "width": 56, "num_frames": 60, "num_rooms": 3}
HOUSE = {"rooms": 3, "period": 200, "laps": 2, "lights": 1, "clutter": 6, "repetition": 0.5}
EVERYTHING = {**HOUSE, "rooms": 2, "style": "random", "motion_blur": 0.6, "exposure": 1.0}
# At silhouettes and edges of shadows the last bit of a float decides which side a pixel belongs to.
ELSEWHERE = 2e-3


def draw(rooms: Rooms, indices: list[int]) -> dict[str, np.ndarray]:
    scenes = RoomScenes(rooms)
    described = [scenes.describe(name, indices) for name in rooms.sequences]
    batch = {name: np.stack([each[name] for each in described]) for name in described[0]}
    return jax.device_get(jax.jit(scenes.draw)(batch))


def assert_same(rooms: Rooms, indices: list[int]) -> None:
    drawn = draw(rooms, indices)
    for row, name in enumerate(rooms.sequences):
        expected = rooms.read(name, indices)
        assert {key: value.dtype for key, value in drawn.items()} == {
            key: getattr(expected, key).dtype for key in drawn
        }
        for key in ("intrinsics", "extrinsics"):
            np.testing.assert_array_equal(drawn[key][row], getattr(expected, key))
        levels = np.abs(drawn["images"][row].astype(int) - expected.images).max(-1)
        depth = np.abs(drawn["depth"][row] / expected.depth - 1.0)
        assert (levels > 1).mean() <= ELSEWHERE and (depth > 1e-4).mean() <= ELSEWHERE
        assert levels[depth <= 1e-4].mean() < 0.01


@pytest.mark.parametrize("options", [{}, {"style": "random"}, HOUSE, EVERYTHING], ids=str)
def test_the_device_draws_what_the_host_draws(options: dict) -> None:
    """Nine rooms at once, by one program."""
    assert_same(Rooms("train", **{**SMALL, "num_rooms": 9}, **options, seed=1), [0, 7, 31])


def test_frames_at_once_are_frames_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert_same(Rooms("val", **SMALL, **EVERYTHING), [3, 4])


def test_empty_places_for_things_change_nothing() -> None:
    rooms = Rooms("val", **{**SMALL, "num_rooms": 1}, lights=2)
    scenes, name = RoomScenes(rooms), rooms.sequences[0]
    described = scenes.describe(name, [0])
    roomy = {**described, **pack(rooms.room(name), (20, 11, 13))}
    assert roomy["boxes"].shape == (20, 8) and described["boxes"].shape == (5, 8)
    first, second = (scenes.draw({key: value[None] for key, value in each.items()}) for each in (described, roomy))
    for key in ("images", "depth"):
        np.testing.assert_array_equal(first[key], second[key])


def test_only_training_on_the_device_describes_rooms() -> None:
    host, device = (Rooms("train", **SMALL, renderer=renderer) for renderer in ("host", "device"))
    assert isinstance(device.for_training(cache_dir=None, progress=False), DrawnOnDevice)
    assert not isinstance(host.for_training(cache_dir=None, progress=False), DrawnOnDevice)
    name = host.sequences[0]
    np.testing.assert_array_equal(host.read(name, [3]).images, device.read(name, [3]).images)
    # What a frame shows does not depend on who draws it.
    assert host.identity == device.identity
