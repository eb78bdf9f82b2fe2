"""MVS-Synth: a room written in the set's encoding comes back, in a right-handed world; damage is named."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from room_video import CENTRE, FOCAL, check_video, room_video, write_image

from logvggt_jax.data.formats.exr import read_exr
from logvggt_jax.data.readers.mvs_synth import MVSSynth

# The game's world has x and y swapped, so that it is left-handed.
SWAP = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
VIEWS = room_video(3)


def write_exr(path: Path, depth: np.ndarray, channel: str = "Y") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {channel: depth}) as file:
        file.write(str(path))


def write_pose(path: Path, extrinsic: np.ndarray, **changes: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = {"f_x": FOCAL, "f_y": FOCAL, "c_x": CENTRE[0], "c_y": CENTRE[1], "extrinsic": extrinsic.tolist()}
    path.write_text(json.dumps(camera | changes))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Sequence 0000 with frames 0 to 2, in metres times ten."""
    folder = tmp_path / "GTAV_720" / "0000"
    for index, each in enumerate(VIEWS):
        write_image(folder / f"images/{index:04d}.png", each.image)
        write_exr(folder / f"depths/{index:04d}.exr", (10 * each.depth).astype(np.float32))
        stored = np.linalg.inv(SWAP @ each.camera_to_world)
        stored[:3, 3] *= 10
        write_pose(folder / f"poses/{index:04d}.json", stored)
    (tmp_path / "GTAV_720" / "num_images.json").write_text("[3]")
    return tmp_path


def test_the_room_comes_back_in_a_right_handed_world(root: Path):
    scenes = MVSSynth(root)
    assert scenes.sequences == ("0000",) and scenes.frame_names("0000") == ["0000", "0001", "0002"]
    frames = scenes.read("0000", [0, 1, 2])
    assert not frames.metric
    in_metres = frames._replace(depth=frames.depth / 10, extrinsics=frames.extrinsics.copy())
    in_metres.extrinsics[:, :3, 3] /= 10
    check_video(in_metres, VIEWS, depth_error=1e-5, same_world=False)
    picked = scenes.read("0000", [2, 0])
    assert np.array_equal(picked.images, frames.images[[2, 0]])


def test_a_right_handed_world_is_refused(root: Path):
    path = root / "GTAV_720/0000/poses/0001.json"
    write_pose(path, np.eye(4))
    with pytest.raises(ValueError, match=r"0001\.json.*left-handed.*\+1"):
        MVSSynth(root).num_frames("0000")


def test_sky_and_other_invalid_depth_become_zero_and_half_floats_are_read(root: Path):
    depth = np.full(VIEWS[0].depth.shape, 7.5, np.float16)
    depth[0, :4] = [np.inf, np.nan, -np.inf, -1]
    depth[1] = 0
    write_exr(root / "GTAV_720/0000/depths/0000.exr", depth, channel="V")
    write_exr(root / "GTAV_720/0000/depths/0001.exr", np.full(depth.shape, np.inf, np.float16))
    frames = MVSSynth(root).read("0000", [0, 1])
    assert not frames.depth[0, 0, :4].any() and not frames.depth[0, 1].any() and (frames.depth[0, 2:] == 7.5).all()
    assert not frames.depth[1].any()


def test_frames_without_finite_cameras_are_dropped_and_counted(root: Path):
    poses = root / "GTAV_720/0000/poses"
    write_pose(poses / "0000.json", np.full((4, 4), np.nan))
    write_pose(poses / "0001.json", SWAP, f_x=float("inf"))
    scenes = MVSSynth(root)
    assert scenes.frame_names("0000") == ["0002"]
    assert scenes.dropped_frames("0000") == {"no pose": 1, "no intrinsics": 1}


def test_only_the_split_all_and_the_size_720_are_read(root: Path):
    with pytest.raises(ValueError, match="MVS-Synth has no split 'train'"):
        MVSSynth(root, "train")
    (root / "GTAV_720").rename(root / "GTAV_540")
    with pytest.raises(FileNotFoundError, match="GTAV_720"):
        MVSSynth(root)


@pytest.mark.parametrize("name", ["images/0001.png", "depths/0001.exr", "poses/0001.json"])
def test_a_missing_file_is_named(root: Path, name: str):
    (root / "GTAV_720/0000" / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        MVSSynth(root).num_frames("0000")


def test_files_that_vanish_or_are_damaged_after_listing_are_named(root: Path, capfd):
    scenes = MVSSynth(root)
    assert scenes.num_frames("0000") == 3
    path = root / "GTAV_720/0000/depths/0001.exr"
    whole = path.read_bytes()
    for damaged in (whole[:-400], whole[: len(whole) // 2], b"", b"not a picture", whole[:900] + b"\xff" * 200):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"0001\.exr: truncated or damaged"):
            scenes.read("0000", [1])
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"0001\.exr"):
        scenes.read("0000", [1])
    capfd.readouterr()  # the library's own complaints


def test_other_channels_pixels_and_sizes_are_named(root: Path):
    path = root / "GTAV_720/0000/depths/0001.exr"
    write_exr(path, np.zeros((48, 64, 3), np.float32), channel="RGB")
    with pytest.raises(ValueError, match=r"0001\.exr: expected one part with one channel, got 1 with B, G, R"):
        MVSSynth(root).read("0000", [1])
    write_exr(path, np.zeros((48, 64), np.uint32))
    with pytest.raises(ValueError, match=r"0001\.exr: expected half or float pixels, got uint32"):
        MVSSynth(root).read("0000", [1])
    write_exr(path, np.zeros((24, 32), np.float32))
    with pytest.raises(ValueError, match=r"0001\.exr: size \(24, 32\)"):
        MVSSynth(root).read("0000", [1])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "JSONDecodeError"),
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
