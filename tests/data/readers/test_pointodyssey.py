"""PointOdyssey: saturated depth is sky; only two arrays are read; older releases; damage."""

import io
import tokenize
import zipfile
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.pointodyssey import STEP, write_cameras, write_sequence
from room_views import SIZE, check_views, write_image

from logvggt_jax.data.readers.pointodyssey import PointOdyssey
from logvggt_jax.errors import InputError


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


def test_an_array_of_unreadable_shape_is_one_line(root: Path):
    """NumPy leaves what follows to Python's tokens, whose error is none of its own."""
    path = root / "train/dancing/anno.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, array)
            header = buffer.getvalue()
            archive.writestr(f"{name}.npy", header.replace(b"), }", b",  }") if name == "extrinsics" else header)
    with np.load(path) as archive, pytest.raises(tokenize.TokenError):
        archive["extrinsics"]
    with pytest.raises(InputError, match=r"anno\.npz: truncated or damaged npz file \(.*fetch it again"):
        PointOdyssey(root).read("train/dancing", range(4))


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
