"""Neural RGB-D: later poses stay with their pictures, far depth, one focal length."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts.nrgbd import LAYOUT
from room_views import SIZE, check_views, write_image

from logvggt_jax.data.readers.nrgbd import NRGBD

VIEWS = LAYOUT.views


@pytest.fixture
def root(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, VIEWS)
    return tmp_path


def test_nan_blocks_are_dropped_and_later_poses_stay_with_their_pictures(tmp_path: Path):
    lost = [replace(each, pose=each.pose * (np.nan if i in (0, 3) else 1)) for i, each in enumerate(VIEWS)]
    LAYOUT.write(tmp_path, lost)
    (tmp_path / "meshes").mkdir()
    nrgbd = NRGBD(tmp_path)
    assert nrgbd.sequences == ("kitchen",) and nrgbd.dropped_frames("kitchen") == {"no pose": 2}
    frames = nrgbd.read("kitchen", [0, 1, 2, 3])
    check_views(frames, [VIEWS[i] for i in (1, 2, 4, 5)], picture_error=0, depth_error=LAYOUT.depth_error)


def test_zero_and_far_depth_is_invalid(root: Path):
    depth = np.full(SIZE, 1500, np.uint16)
    depth[0, :4] = [0, 10_000, 10_001, 65_535]
    write_image(root / "kitchen/depth/depth0.png", depth)
    np.testing.assert_array_equal(NRGBD(root).read("kitchen", [0]).depth[0, 0, :5], np.float32([0, 10, 0, 0, 1.5]))


def test_infinite_poses_are_lost_too(root: Path):
    poses = root / "kitchen/poses.txt"
    lines = poses.read_text().splitlines()
    lines[4] = "-inf -inf -inf -inf"
    poses.write_text("\n".join(lines))
    assert NRGBD(root).dropped_frames("kitchen") == {"no pose": 1}
