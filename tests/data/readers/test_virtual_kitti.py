"""Virtual KITTI 2: both cameras come back from interleaved rows; the split; damaged tables."""

from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.virtual_kitti import BASELINE, LAYOUT, RIGHT, write_variation
from room_views import FOCAL, SIZE, check_views, write_image

from logvggt_jax.data.readers.virtual_kitti import VirtualKITTI


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_variation(tmp_path / "Scene01/clone")
    write_variation(tmp_path / "Scene20/15-deg-left", VIEWS[:1], RIGHT[:1])
    (tmp_path / "Scene01/notes").mkdir()
    return tmp_path


def test_the_cameras_have_their_own_rows_and_are_a_baseline_apart(root: Path):
    drives = VirtualKITTI(root)
    frames = drives.read("Scene01/clone/Camera_0", range(4))
    check_views(frames, VIEWS, picture_error=2.0, depth_error=LAYOUT.depth_error)
    left, right = (drives.read(f"Scene01/clone/Camera_{camera}", [1]).extrinsics[0] for camera in (0, 1))
    np.testing.assert_allclose(left[:3, :3], right[:3, :3], atol=1e-6)
    np.testing.assert_allclose(right[:3, 3] - left[:3, 3], [-BASELINE, 0, 0], atol=1e-5)


def test_intrinsics_are_those_of_the_frame_and_camera(root: Path):
    edit(root / "Scene01/clone/intrinsic.txt", f"1 1 {FOCAL} {FOCAL}", "1 1 70.5 71.5")
    drives = VirtualKITTI(root)
    assert drives.read("Scene01/clone/Camera_1", [0, 1, 2]).intrinsics[:, 0, 0].tolist() == [FOCAL, 70.5, FOCAL]
    assert drives.read("Scene01/clone/Camera_1", [1]).intrinsics[0, 1, 1] == 71.5
    assert (drives.read("Scene01/clone/Camera_0", [0, 1, 2]).intrinsics[:, 0, 0] == FOCAL).all()


def test_sky_becomes_zero(root: Path):
    depth = np.full(SIZE, 65534, np.uint16)
    depth[0, :3] = [65535, 0, 1]
    write_image(root / "Scene01/clone/frames/depth/Camera_0/depth_00000.png", depth)
    frames = VirtualKITTI(root).read("Scene01/clone/Camera_0", [0])
    np.testing.assert_allclose(frames.depth[0, 0, :4], [0, 0, 0.01, 655.34], rtol=1e-6)


def test_splits_hold_the_last_scene_out(root: Path):
    first = ("Scene01/clone/Camera_0", "Scene01/clone/Camera_1")
    last = ("Scene20/15-deg-left/Camera_0", "Scene20/15-deg-left/Camera_1")
    assert VirtualKITTI(root).sequences == first + last
    assert VirtualKITTI(root, "train").sequences == first
    assert VirtualKITTI(root, "test").sequences == last


def test_a_variation_without_pictures_is_named(root: Path):
    (root / "Scene01/fog").mkdir()
    with pytest.raises(FileNotFoundError, match="Scene01/fog/frames/rgb"):
        VirtualKITTI(root)
