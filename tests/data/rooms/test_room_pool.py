"""The pool holds what `Rooms` renders, is opened rather than rendered again, and is never left half-written."""

import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from logvggt_jax.data.cache_use import cache_in_use
from logvggt_jax.data.rooms import pool as room_pool
from logvggt_jax.data.rooms.pool import render_pool
from logvggt_jax.data.rooms.rooms import Rooms
from logvggt_jax.errors import DiskError, InputError

ROOMS = Rooms("val", height=28, width=42, num_frames=5, num_rooms=3)


def assert_same_frames(pool, rooms: Rooms) -> None:
    for name in rooms.sequences:
        expected, got = rooms.read(name, [4, 0, 2]), pool.read(name, [4, 0, 2])
        for key in ("images", "depth", "intrinsics", "extrinsics"):
            assert np.array_equal(getattr(expected, key), getattr(got, key)), key
        assert got.metric and pool.frame_names(name) == rooms.frame_names(name)
    assert pool.sequences == rooms.sequences and pool.identity == rooms.identity


def test_a_pool_in_memory_equals_rendering_on_demand():
    pool = render_pool(ROOMS, progress=False)
    assert_same_frames(pool, ROOMS)
    assert_same_frames(pickle.loads(pickle.dumps(pool)), ROOMS)


def test_what_is_read_is_a_copy():
    pool = render_pool(ROOMS, progress=False)
    pool.read(ROOMS.sequences[0], [0, 1]).depth[:] = -1
    assert_same_frames(pool, ROOMS)


def test_a_cached_pool_is_opened_not_rendered_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert_same_frames(render_pool(ROOMS, cache_dir=tmp_path, progress=False), ROOMS)
    monkeypatch.setattr(room_pool, "_read_all", lambda *_: pytest.fail("rendered although cached"))
    pool = render_pool(ROOMS, cache_dir=tmp_path, progress=False)
    assert_same_frames(pool, ROOMS)
    sent = pickle.dumps(pool)
    assert len(sent) < 5000
    assert_same_frames(pickle.loads(sent), ROOMS)


@pytest.mark.parametrize("options", [{"speed": 1.5}, {"num_rooms": 2}])
def test_other_options_have_another_cache(options: dict, tmp_path: Path):
    render_pool(ROOMS, cache_dir=tmp_path, progress=False)
    other = Rooms("val", **{"height": 28, "width": 42, "num_frames": 5, "num_rooms": 3, **options})
    assert_same_frames(render_pool(other, cache_dir=tmp_path, progress=False), other)
    names = sorted(path.name.partition("-")[0] for path in tmp_path.iterdir())
    assert names == ["rooms", "rooms", "rooms.lock"]


def test_an_interrupted_rendering_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(rooms: Rooms, sequence: str):
        if sequence == rooms.sequences[1]:
            raise KeyboardInterrupt
        return rooms.read(sequence, range(5))

    monkeypatch.setattr(room_pool, "_read_all", interrupted)
    with pytest.raises(KeyboardInterrupt):
        render_pool(ROOMS, cache_dir=tmp_path, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["rooms.lock"]


def test_what_a_killed_rendering_left_goes_unless_another_is_at_work(tmp_path: Path):
    left = tmp_path / "rooms-0123456789abcdef.7-cd.partial"
    left.mkdir()
    (left / "depth.npy").write_bytes(b"half")
    with cache_in_use(tmp_path, "rooms", ()):
        render_pool(ROOMS, cache_dir=tmp_path, progress=False)
        assert left.exists(), "another process may be writing it"
    other = Rooms("val", height=28, width=42, num_frames=5, num_rooms=2)
    render_pool(other, cache_dir=tmp_path, progress=False)
    assert not left.exists() and len(list(tmp_path.glob("rooms-*"))) == 2


def test_a_damaged_cache_is_named(tmp_path: Path):
    folder = render_pool(ROOMS, cache_dir=tmp_path, progress=False).folder
    with (folder / "depth.npy").open("r+b") as file:
        file.truncate(1000)
    with pytest.raises(ValueError, match=r"depth\.npy.*delete"):
        render_pool(ROOMS, cache_dir=tmp_path, progress=False)


def test_a_pool_too_large_for_memory_is_refused():
    with pytest.raises(InputError, match=r"more than the 8\.6 GB .* data\.cache_dir .* num_rooms"):
        render_pool(Rooms("train", num_frames=1000))


def test_a_pool_on_disk_is_bounded_by_its_free_space_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert_same_frames(render_pool(ROOMS, cache_dir=tmp_path / "pools", max_bytes=1, progress=False), ROOMS)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10))
    with pytest.raises(DiskError, match=r"needs about .* give data\.cache_dir another folder"):
        render_pool(ROOMS, cache_dir=tmp_path / "full", progress=False)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["rooms.lock"]


def test_worker_processes_render_the_same(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(room_pool, "_SERIAL_PIXELS", 0)
    assert_same_frames(render_pool(ROOMS, workers=2, progress=False), ROOMS)
