"""Replica: the camera file decides, or the rendering's own camera; poses belong to pictures by their line."""

from pathlib import Path

import pytest
from analytic_room import pinhole
from layouts.layout import VIEWS
from layouts.replica import SCALE, write, write_camera, write_scene
from room_views import check_views, room_views

from logvggt_jax.data.readers.replica import Replica

ERRORS = {"picture_error": 2.0, "depth_error": 0.51 / SCALE}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write(tmp_path, VIEWS)
    return tmp_path


def test_scenes_are_the_folders_with_poses_or_pictures(root: Path):
    write_scene(root / "office1", VIEWS[:3])
    (root / "room0_mesh.ply").write_bytes(b"ply")
    (root / "notes").mkdir()
    assert Replica(root).sequences == ("office1", "room0")


def test_intrinsics_scale_with_the_picture(root: Path):
    write_camera(root, w=640, h=480, fx=550.0, fy=550.0, cx=312.0, cy=249.5)
    check_views(Replica(root).read("room0", [0, 1]), VIEWS[:2], **ERRORS)


def test_without_the_camera_file_the_renderings_own_is_used(tmp_path: Path):
    views = room_views(3, pinhole((34, 60), 30.0), (34, 60))
    write_scene(tmp_path / "room0", views)
    check_views(Replica(tmp_path).read("room0", [0, 1, 2]), views, **ERRORS)
