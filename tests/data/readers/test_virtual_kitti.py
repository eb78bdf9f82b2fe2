"""Virtual KITTI 2: both cameras of a written room come back from interleaved rows; damage is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_room import camera_to_world, view
from room_video import CENTRE, FOCAL, INTRINSICS, SIZE, View, check_video, room_video, write_image

from logvggt_jax.data.readers.virtual_kitti import VirtualKITTI

BASELINE = 0.532725


def right_view(index: int) -> View:
    pose = camera_to_world(index)
    pose[:3, 3] += BASELINE * pose[:3, 0]
    return View(*view(pose, INTRINSICS, SIZE), pose)


CAMERAS = (room_video(3), [right_view(index) for index in range(3)])


def write_variation(folder: Path, cameras=CAMERAS) -> None:
    intrinsic = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    extrinsic = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"]
    for frame in range(len(cameras[0])):
        for camera, views in enumerate(cameras):
            each = views[frame]
            write_image(folder / f"frames/rgb/Camera_{camera}/rgb_{frame:05d}.jpg", each.image)
            depth = np.rint(100 * each.depth).astype(np.uint16)
            write_image(folder / f"frames/depth/Camera_{camera}/depth_{frame:05d}.png", depth)
            intrinsic.append(f"{frame} {camera} {FOCAL} {FOCAL} {CENTRE[0]} {CENTRE[1]}")
            extrinsic.append(f"{frame} {camera} " + " ".join(map(str, each.extrinsics.ravel())))
    (folder / "intrinsic.txt").write_text("\n".join(intrinsic) + "\n")
    (folder / "extrinsic.txt").write_text("\n".join(extrinsic) + "\n")


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_variation(tmp_path / "Scene01/clone")
    write_variation(tmp_path / "Scene20/15-deg-left", [views[:1] for views in CAMERAS])
    (tmp_path / "Scene01/notes").mkdir()
    return tmp_path


@pytest.mark.parametrize("camera", [0, 1])
def test_each_camera_comes_back_with_its_own_rows(root: Path, camera: int):
    drives = VirtualKITTI(root)
    sequence = f"Scene01/clone/Camera_{camera}"
    assert drives.frame_names(sequence) == ["rgb_00000", "rgb_00001", "rgb_00002"]
    frames = drives.read(sequence, [0, 1, 2])
    assert frames.metric
    check_video(frames, CAMERAS[camera], depth_error=0.0051, colour_error=2.0)


def test_the_cameras_are_a_baseline_apart(root: Path):
    drives = VirtualKITTI(root)
    left, right = (drives.read(f"Scene01/clone/Camera_{camera}", [1]).extrinsics[0] for camera in (0, 1))
    np.testing.assert_allclose(left[:3, :3], right[:3, :3], atol=1e-6)
    np.testing.assert_allclose(right[:3, 3] - left[:3, 3], [-BASELINE, 0, 0], atol=1e-5)


def test_intrinsics_are_those_of_the_frame_and_camera(root: Path):
    edit(root / "Scene01/clone/intrinsic.txt", f"1 1 {FOCAL} {FOCAL}", "1 1 70.5 71.5")
    drives = VirtualKITTI(root)
    assert drives.read("Scene01/clone/Camera_1", [0, 1, 2]).intrinsics[:, 0, 0].tolist() == [FOCAL, 70.5, FOCAL]
    assert drives.read("Scene01/clone/Camera_1", [1]).intrinsics[0, 1, 1] == 71.5
    assert (drives.read("Scene01/clone/Camera_0", [0, 1, 2]).intrinsics[:, 0, 0] == FOCAL).all()


def test_sky_and_missing_depth_become_zero(root: Path):
    depth = np.full(SIZE, 65534, np.uint16)
    depth[0, :3] = [65535, 0, 1]
    folder = root / "Scene01/clone/frames/depth/Camera_0"
    write_image(folder / "depth_00000.png", depth)
    write_image(folder / "depth_00001.png", np.full(SIZE, 65535, np.uint16))
    frames = VirtualKITTI(root).read("Scene01/clone/Camera_0", [0, 1])
    np.testing.assert_allclose(frames.depth[0, 0, :4], [0, 0, 0.01, 655.34], rtol=1e-6)
    assert not frames.depth[1].any()


def test_splits_hold_the_last_scene_out(root: Path):
    first = ("Scene01/clone/Camera_0", "Scene01/clone/Camera_1")
    last = ("Scene20/15-deg-left/Camera_0", "Scene20/15-deg-left/Camera_1")
    assert VirtualKITTI(root).sequences == first + last
    assert VirtualKITTI(root, "train").sequences == first
    assert VirtualKITTI(root, "test").sequences == last
    with pytest.raises(ValueError, match="Virtual KITTI 2 has no split 'val'"):
        VirtualKITTI(root, "val")


def test_lost_frames_are_dropped_and_counted(root: Path):
    lines = (root / "Scene01/clone/extrinsic.txt").read_text().splitlines()
    lines[1] = "0 0" + " nan" * 16
    (root / "Scene01/clone/extrinsic.txt").write_text("\n".join(lines))
    edit(root / "Scene01/clone/intrinsic.txt", f"2 0 {FOCAL}", "2 0 inf")
    drives = VirtualKITTI(root)
    assert drives.frame_names("Scene01/clone/Camera_0") == ["rgb_00001"]
    assert drives.dropped_frames("Scene01/clone/Camera_0") == {"no pose": 1, "no intrinsics": 1}
    assert drives.num_frames("Scene01/clone/Camera_1") == 3


@pytest.mark.parametrize(
    "name",
    ["frames/rgb/Camera_1/rgb_00001.jpg", "frames/depth/Camera_1/depth_00001.png", "intrinsic.txt", "extrinsic.txt"],
)
def test_a_missing_file_is_named(root: Path, name: str):
    (root / "Scene01/clone" / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        VirtualKITTI(root).num_frames("Scene01/clone/Camera_1")


def test_a_variation_without_pictures_is_named(root: Path):
    (root / "Scene01/fog").mkdir()
    with pytest.raises(FileNotFoundError, match="Scene01/fog/frames/rgb"):
        VirtualKITTI(root)


@pytest.mark.parametrize("name", ["intrinsic.txt", "extrinsic.txt"])
def test_damaged_tables_are_named(root: Path, name: str):
    path = root / "Scene01/clone" / name
    lines = path.read_text().splitlines()
    for damaged, complaint in (
        ([line for line in lines if not line.startswith("1 1")], "no row for frame 1 of Camera_1"),
        (lines[1:], "expected a header"),
        ([], "expected a header"),
        ([*lines[:-1], lines[-1].rpartition(" ")[0]], "line 7: expected (6|18) numbers, got (5|17)"),
        ([*lines[:-1], lines[-1] + "x"], "line 7: expected numbers"),
    ):
        path.write_text("\n".join(damaged))
        with pytest.raises(ValueError, match=rf"{name}.*{complaint}"):
            VirtualKITTI(root).num_frames("Scene01/clone/Camera_1")


def test_poses_that_are_not_rotations_and_absurd_intrinsics_are_named(root: Path):
    edit(root / "Scene01/clone/intrinsic.txt", f"1 1 {FOCAL}", "1 1 0.01")
    with pytest.raises(ValueError, match=r"rgb_00001\.jpg: intrinsics fx=0\.01"):
        VirtualKITTI(root).read("Scene01/clone/Camera_1", [1])
    lines = (root / "Scene01/clone/extrinsic.txt").read_text().splitlines()
    lines[4] = "1 1 " + " ".join(map(str, np.diag([1, -1, 1, 1]).ravel()))
    (root / "Scene01/clone/extrinsic.txt").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"extrinsic\.txt, frame 1 of Camera_1: not a rigid transform"):
        VirtualKITTI(root).num_frames("Scene01/clone/Camera_1")


def test_pictures_that_do_not_belong_together_are_named(root: Path):
    folder = root / "Scene01/clone/frames/depth/Camera_0"
    write_image(folder / "depth_00001.png", np.ones((24, 32), np.uint16))
    with pytest.raises(ValueError, match=r"depth_00001\.png: size \(24, 32\)"):
        VirtualKITTI(root).read("Scene01/clone/Camera_0", [1])
    write_image(folder / "depth_00001.png", np.ones(SIZE, np.uint8))
    with pytest.raises(ValueError, match=r"depth_00001\.png: expected 16-bit"):
        VirtualKITTI(root).read("Scene01/clone/Camera_0", [1])
