"""PointOdyssey: a written room comes back; saturated depth is sky; only two arrays are read; older releases."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from room_video import INTRINSICS, SIZE, check_video, room_video, write_image

from logvggt_jax.data.readers.pointodyssey import PointOdyssey

VIEWS = room_video(3)
STEP = 1000 / 65535


def write_cameras(folder: Path, **changes: np.ndarray | None) -> None:
    arrays: dict[str, np.ndarray | None] = {
        "trajs_2d": np.zeros((3, 5, 2), np.float32),
        "trajs_3d": np.zeros((3, 5, 3), np.float32),
        "visibs": np.ones((3, 5), bool),
        "valids": np.ones((3, 5), bool),
        "intrinsics": np.stack([INTRINSICS] * 3).astype(np.float32),
        "extrinsics": np.stack([each.extrinsics for each in VIEWS]).astype(np.float32),
    }
    np.savez(folder / "anno.npz", **{name: array for name, array in (arrays | changes).items() if array is not None})


def write_sequence(folder: Path) -> None:
    for index, each in enumerate(VIEWS):
        write_image(folder / f"rgbs/rgb_{index:05d}.jpg", each.image)
        write_image(folder / f"depths/depth_{index:05d}.png", np.rint(each.depth / STEP).astype(np.uint16))
        write_image(folder / f"masks/mask_{index:05d}.png", each.image)
    write_cameras(folder)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("train/dancing", "val/ani", "test/ani"):
        write_sequence(tmp_path / name)
    return tmp_path


def test_the_room_comes_back(root: Path):
    frames = PointOdyssey(root).read("train/dancing", [0, 1, 2])
    assert frames.metric
    check_video(frames, VIEWS, depth_error=0.51 * STEP, colour_error=2.0)
    assert PointOdyssey(root).frame_names("train/dancing") == ["rgb_00000", "rgb_00001", "rgb_00002"]


def test_saturated_and_missing_depth_become_zero(root: Path):
    depth = np.full(SIZE, 65534, np.uint16)
    depth[0, :3] = [65535, 0, 1]
    write_image(root / "train/dancing/depths/depth_00000.png", depth)
    write_image(root / "train/dancing/depths/depth_00001.png", np.full(SIZE, 65535, np.uint16))
    frames = PointOdyssey(root).read("train/dancing", [0, 1])
    np.testing.assert_allclose(frames.depth[0, 0, :4], [0, 0, STEP, 1000 - STEP], rtol=1e-6)
    assert not frames.depth[1].any()


def test_splits_are_the_folders(root: Path):
    assert PointOdyssey(root).sequences == ("train/dancing", "val/ani", "test/ani")
    for split in ("train", "val", "test"):
        (name,) = PointOdyssey(root, split).sequences
        assert name.startswith(f"{split}/")
    (root / "val").rename(root / "validation")
    assert PointOdyssey(root).sequences == ("train/dancing", "test/ani")
    with pytest.raises(FileNotFoundError, match="val: no such folder"):
        PointOdyssey(root, "val")


def test_a_split_that_arrives_later_is_seen(root: Path):
    (root / "val").rename(root / "later")
    assert len(PointOdyssey(root).sequences) == 2
    (root / "later").rename(root / "val")
    assert len(PointOdyssey(root).sequences) == 3


def test_point_tracks_are_not_read(root: Path):
    path = root / "train/dancing/anno.npz"
    write_cameras(path.parent, trajs_3d=np.full((3, 5000, 3), 7.25))
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("trajs_3d.npy").header_offset
    content = bytearray(path.read_bytes())
    content[start + 1000 : start + 2000] = bytes(1000)
    path.write_bytes(content)
    with np.load(path) as archive, pytest.raises(zipfile.BadZipFile):
        archive["trajs_3d"]
    check_video(PointOdyssey(root).read("train/dancing", [0, 1, 2]), VIEWS, depth_error=0.51 * STEP, colour_error=2.0)


def test_arrays_of_python_objects_are_refused(root: Path):
    write_cameras(root / "train/dancing", extrinsics=np.array([{}, {}, {}], dtype=object))
    with pytest.raises(ValueError, match=r"anno\.npz: truncated or damaged.*allow_pickle"):
        PointOdyssey(root).num_frames("train/dancing")


def test_older_releases_are_refused(root: Path):
    folder = root / "train/dancing"
    write_cameras(folder, valids=None)
    with pytest.raises(ValueError, match=r"anno\.npz: .*valids.*fetch v1\.2"):
        PointOdyssey(root).num_frames("train/dancing")
    (folder / "anno.npz").rename(folder / "annotations.npz")
    with pytest.raises(FileNotFoundError, match=r"anno\.npz.*annotations\.npz is of an older release.*fetch v1\.2"):
        PointOdyssey(root).num_frames("train/dancing")
    (folder / "annotations.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"anno\.npz: no such file; fetch it again"):
        PointOdyssey(root).num_frames("train/dancing")


def test_frames_without_finite_cameras_are_dropped_and_counted(root: Path):
    poses = np.stack([each.extrinsics for each in VIEWS])
    intrinsics = np.stack([INTRINSICS] * 3)
    poses[0, 0, 0], intrinsics[2, 0, 0] = -np.inf, np.nan
    write_cameras(root / "train/dancing", extrinsics=poses, intrinsics=intrinsics)
    videos = PointOdyssey(root)
    assert videos.frame_names("train/dancing") == ["rgb_00001"]
    assert videos.dropped_frames("train/dancing") == {"no pose": 1, "no intrinsics": 1}


@pytest.mark.parametrize("name", ["rgbs/rgb_00001.jpg", "depths/depth_00001.png"])
def test_a_missing_file_is_named(root: Path, name: str):
    (root / "train/dancing" / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        PointOdyssey(root).num_frames("train/dancing")


def test_unequal_counts_are_named(root: Path):
    folder = root / "train/dancing"
    for name in ("rgbs/rgb_00002.jpg", "depths/depth_00002.png"):
        (folder / name).unlink()
    with pytest.raises(ValueError, match=r"train/dancing: expected frames 0 to 2.*got 2 frames from 0 to 1"):
        PointOdyssey(root).num_frames("train/dancing")
    # As many, but not those.
    write_image(folder / "rgbs/rgb_00003.jpg", VIEWS[2].image)
    write_image(folder / "depths/depth_00003.png", np.ones(SIZE, np.uint16))
    with pytest.raises(ValueError, match="got 3 frames from 0 to 3"):
        PointOdyssey(root).num_frames("train/dancing")


def test_damaged_cameras_are_named(root: Path):
    folder = root / "train/dancing"
    path = folder / "anno.npz"
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("extrinsics.npy").header_offset
    flipped = bytearray(whole)
    flipped[start + 200 : start + 240] = bytes(40)
    for damaged in (whole[:-50], b"", b"not an archive", bytes(flipped)):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"train/dancing/anno\.npz: truncated or damaged"):
            PointOdyssey(root).num_frames("train/dancing")
    with path.open("wb") as file:
        np.save(file, np.eye(4))
    with pytest.raises(ValueError, match=r"anno\.npz: truncated or damaged"):
        PointOdyssey(root).num_frames("train/dancing")
    for name, array in (
        ("intrinsics", np.zeros((2, 3, 3))),
        ("extrinsics", np.zeros((3, 3, 4))),
        ("extrinsics", np.zeros((0, 4, 4))),
        ("extrinsics", np.array("none")),
    ):
        write_cameras(folder, **{name: array})
        with pytest.raises(ValueError, match=r"anno\.npz: expected (in|ex)trinsics of"):
            PointOdyssey(root).num_frames("train/dancing")
    write_cameras(folder, extrinsics=np.stack([np.diag([1.0, 1, -1, 1])] * 3))
    with pytest.raises(ValueError, match=r"anno\.npz, extrinsics of frame 0: not a rigid transform"):
        PointOdyssey(root).num_frames("train/dancing")


def test_pictures_and_intrinsics_that_do_not_belong_together_are_named(root: Path):
    folder = root / "train/dancing"
    write_image(folder / "depths/depth_00001.png", np.ones((24, 32), np.uint16))
    with pytest.raises(ValueError, match=r"depth_00001\.png: size \(24, 32\)"):
        PointOdyssey(root).read("train/dancing", [1])
    write_cameras(folder, intrinsics=np.stack([np.diag([-55.0, 55, 1])] * 3))
    with pytest.raises(ValueError, match=r"rgb_00000\.jpg: intrinsics fx=-55"):
        PointOdyssey(root).read("train/dancing", [0])
