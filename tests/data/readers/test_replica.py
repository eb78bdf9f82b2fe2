"""Replica: the camera file decides, or the rendering's own camera; poses belong to pictures by their line."""

from pathlib import Path

import pytest
from analytic_room import pinhole
from layouts.layout import VIEWS
from layouts.replica import SCALE, write, write_camera, write_scene
from room_views import check_views, room_views

from logvggt_jax.data.readers.replica import Replica
from logvggt_jax.errors import InputError

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


@pytest.mark.parametrize("with_camera_file", [True, False])
def test_pictures_of_another_shape_than_the_cameras_are_refused(tmp_path: Path, with_camera_file: bool):
    """Those of another rendering, or cropped: stretched, their focal lengths would differ, and look like a camera's."""
    views = room_views(3, pinhole((48, 64), 32.0), (48, 64))
    write_scene(tmp_path / "room0", views)
    if with_camera_file:
        write_camera(tmp_path, w=1200, h=680)
    named = r" \S*cam_params\.json" if with_camera_file else ""
    with pytest.raises(
        InputError, match=rf"frame000000\.jpg.*64 x 48 does not have the shape of its calibration{named} \("
    ):
        Replica(tmp_path).read("room0", [0])
