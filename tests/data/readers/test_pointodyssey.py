"""PointOdyssey: saturated depth is sky; only two arrays are read; older releases; damage."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.pointodyssey import STEP, write_cameras, write_sequence
from room_views import INTRINSICS, SIZE, check_views, write_image

from logvggt_jax.data.readers.pointodyssey import PointOdyssey


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("train/dancing", "val/ani", "test/ani"):
        write_sequence(tmp_path / name)
    return tmp_path


def test_saturated_depth_becomes_zero(root: Path):
    depth = np.full(SIZE, 65534, np.uint16)
    depth[0, :3] = [65535, 0, 1]
    write_image(root / "train/dancing/depths/depth_00000.png", depth)
    frames = PointOdyssey(root).read("train/dancing", [0])
    np.testing.assert_allclose(frames.depth[0, 0, :4], [0, 0, STEP, 1000 - STEP], rtol=1e-6)


def test_splits_are_the_folders(root: Path):
    assert PointOdyssey(root).sequences == ("train/dancing", "val/ani", "test/ani")
    for split in ("train", "val", "test"):
        (name,) = PointOdyssey(root, split).sequences
        assert name.startswith(f"{split}/")
    (root / "val").rename(root / "validation")
    assert PointOdyssey(root).sequences == ("train/dancing", "test/ani")
    with pytest.raises(FileNotFoundError, match="val: no such folder"):
        PointOdyssey(root, "val")
    # One that arrives later is seen.
    (root / "validation").rename(root / "val")
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
    frames = PointOdyssey(root).read("train/dancing", range(4))
    check_views(frames, VIEWS, picture_error=2.0, depth_error=0.51 * STEP)


def test_older_releases_are_refused(root: Path):
    folder = root / "train/dancing"
    write_cameras(folder, valids=None)
    with pytest.raises(ValueError, match=r"anno\.npz: .*valids.*fetch v1\.2"):
        PointOdyssey(root).num_frames("train/dancing")
    (folder / "anno.npz").rename(folder / "annotations.npz")
    with pytest.raises(FileNotFoundError, match=r"anno\.npz.*annotations\.npz is of an older release.*fetch v1\.2"):
        PointOdyssey(root).num_frames("train/dancing")


def test_frames_without_finite_intrinsics_are_dropped_and_counted(root: Path):
    intrinsics = np.stack([INTRINSICS] * 4)
    intrinsics[2, 0, 0] = np.nan
    write_cameras(root / "train/dancing", intrinsics=intrinsics)
    assert PointOdyssey(root).dropped_frames("train/dancing") == {"no intrinsics": 1}


def test_unequal_counts_are_named(root: Path):
    folder = root / "train/dancing"
    for name in ("rgbs/rgb_00003.jpg", "depths/depth_00003.png"):
        (folder / name).unlink()
    with pytest.raises(ValueError, match=r"train/dancing: expected frames 0 to 3.*got 3 frames from 0 to 2"):
        PointOdyssey(root).num_frames("train/dancing")
    # As many, but not those.
    write_image(folder / "rgbs/rgb_00004.jpg", VIEWS[2].picture)
    write_image(folder / "depths/depth_00004.png", np.ones(SIZE, np.uint16))
    with pytest.raises(ValueError, match="got 4 frames from 0 to 4"):
        PointOdyssey(root).num_frames("train/dancing")


def test_damaged_cameras_are_named(root: Path):
    folder = root / "train/dancing"
    path = folder / "anno.npz"
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("extrinsics.npy").header_offset
    flipped = bytearray(whole)
    flipped[start + 200 : start + 240] = bytes(40)
    for damaged in (whole[:-50], bytes(flipped)):
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
    write_cameras(folder, extrinsics=np.array([{}, {}, {}], dtype=object))
    with pytest.raises(ValueError, match=r"anno\.npz: truncated or damaged.*allow_pickle"):
        PointOdyssey(root).num_frames("train/dancing")


def test_absurd_intrinsics_are_named(root: Path):
    write_cameras(root / "train/dancing", intrinsics=np.stack([np.diag([-55.0, 55, 1])] * 4))
    with pytest.raises(ValueError, match=r"rgb_00000\.jpg: intrinsics fx=-55"):
        PointOdyssey(root).read("train/dancing", [0])
