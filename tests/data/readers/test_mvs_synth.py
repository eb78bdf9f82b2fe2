"""MVS-Synth: the left-handed world, half floats and sky, the one size that is read."""

import sys
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.mvs_synth import LAYOUT, SWAP, write_exr, write_pose

from logvggt_jax.data.formats.exr import read_exr
from logvggt_jax.data.readers.mvs_synth import MVSSynth


@pytest.fixture
def root(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, VIEWS)
    return tmp_path


def test_a_right_handed_world_is_refused(root: Path):
    write_pose(root / "GTAV_720/0000/poses/0001.json", np.eye(4))
    with pytest.raises(ValueError, match=r"0001\.json.*left-handed.*\+1"):
        MVSSynth(root).num_frames("0000")


def test_sky_and_other_invalid_depth_become_zero_and_half_floats_are_read(root: Path):
    depth = np.full(VIEWS[0].depth.shape, 7.5, np.float16)
    depth[0, :4] = [np.inf, np.nan, -np.inf, -1]
    depth[1] = 0
    write_exr(root / "GTAV_720/0000/depths/0000.exr", depth, channel="V")
    frames = MVSSynth(root).read("0000", [0])
    assert not frames.depth[0, 0, :4].any() and not frames.depth[0, 1].any() and (frames.depth[0, 2:] == 7.5).all()


def test_frames_without_finite_intrinsics_are_dropped_and_counted(root: Path):
    write_pose(root / "GTAV_720/0000/poses/0001.json", SWAP, f_x=float("inf"))
    assert MVSSynth(root).dropped_frames("0000") == {"no intrinsics": 1}


def test_only_the_size_720_is_read(root: Path):
    (root / "GTAV_720").rename(root / "GTAV_540")
    with pytest.raises(FileNotFoundError, match="GTAV_720"):
        MVSSynth(root)


def test_pixels_that_cannot_be_decoded_are_named(root: Path, capfd):
    path = root / "GTAV_720/0000/depths/0001.exr"
    path.write_bytes(path.read_bytes()[:900] + b"\xff" * 200)
    with pytest.raises(ValueError, match=r"0001\.exr: truncated or damaged"):
        MVSSynth(root).read("0000", [1])
    capfd.readouterr()  # the library's own complaints


def test_other_channels_and_pixels_are_named(root: Path):
    path = root / "GTAV_720/0000/depths/0001.exr"
    write_exr(path, np.zeros((48, 64, 3), np.float32), channel="RGB")
    with pytest.raises(ValueError, match=r"0001\.exr: expected one part with one channel, got 1 with B, G, R"):
        MVSSynth(root).read("0000", [1])
    write_exr(path, np.zeros((48, 64), np.uint32))
    with pytest.raises(ValueError, match=r"0001\.exr: expected half or float pixels, got uint32"):
        MVSSynth(root).read("0000", [1])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[]", "TypeError"),
        ('{"extrinsic": [[1]]}', "f_x"),
        ('{"extrinsic": [[1]], "f_x": 1, "f_y": 1, "c_x": 1, "c_y": 1}', r"4 x 4 numbers, got \(1, 1\)"),
    ],
)
def test_a_bad_pose_file_is_named(root: Path, text: str, complaint: str):
    (root / "GTAV_720/0000/poses/0001.json").write_text(text)
    with pytest.raises(ValueError, match=rf"0001\.json.*{complaint}"):
        MVSSynth(root).num_frames("0000")


def test_intrinsics_of_another_size_are_named(root: Path):
    write_pose(root / "GTAV_720/0000/poses/0001.json", SWAP, c_x=960.0, c_y=540.0)
    with pytest.raises(ValueError, match=r"0001\.png: intrinsics .* cannot belong to a picture of 64 x 48"):
        MVSSynth(root).read("0000", [1])


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ImportError, match=r"logvggt-jax\[data\]"):
        read_exr(tmp_path / "0000.exr")
