"""COLMAP's models: binary and text, every kind of depth or none, cameras that are no pinhole, unregistered pictures."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts.colmap import (
    LAYOUT,
    NAME,
    NAMES,
    write,
    write_binary_model,
    write_depth_map,
    write_pictures,
    write_text_model,
)
from layouts.layout import VIEWS
from room_views import INTRINSICS, RoomView, check_views, write_image

from logvggt_jax.data.readers.colmap import Colmap
from logvggt_jax.errors import InputError

ERRORS = {"picture_error": 0.0, "depth_error": LAYOUT.depth_error}


def test_the_text_form_is_the_binary_one(tmp_path: Path):
    write(tmp_path / "binary", VIEWS)
    folder = tmp_path / "text" / NAME
    write_pictures(folder, VIEWS)
    write_text_model(folder / "sparse/0", VIEWS)
    binary, text = (Colmap(tmp_path / kind) for kind in ("binary", "text"))
    assert text.frame_names(NAME) == binary.frame_names(NAME) == list(NAMES)
    np.testing.assert_array_equal(text.extrinsics(NAME), binary.extrinsics(NAME))
    frames = text.read(NAME, range(4))
    np.testing.assert_array_equal(frames.intrinsics, binary.read(NAME, range(4)).intrinsics)
    assert not frames.depth.any()


def test_colmaps_own_workspace_comes_back_as_the_root(tmp_path: Path):
    """As the undistorter makes it: the model in `sparse`, maps beside the pictures; invalid depth is 0."""
    write_pictures(tmp_path, VIEWS)
    write_binary_model(tmp_path / "sparse", VIEWS)
    for name, each in zip(NAMES, VIEWS, strict=True):
        write_depth_map(tmp_path, name, each.depth)
    dataset = Colmap(tmp_path)
    assert dataset.sequences == (tmp_path.name,)
    check_views(dataset.read(tmp_path.name, range(4)), VIEWS, picture_error=0, depth_error=1e-6)
    depth = VIEWS[1].depth.copy()
    depth[0], depth[1], depth[2] = np.nan, -1, 0
    write_depth_map(tmp_path, NAMES[1], depth)
    found = dataset.read(tmp_path.name, [1]).depth[0]
    assert not found[:3].any() and found[3:].all()


def test_the_only_model_is_read_whatever_its_number(tmp_path: Path):
    write(tmp_path, VIEWS)
    (tmp_path / NAME / "sparse/0").rename(tmp_path / NAME / "sparse/1")
    check_views(Colmap(tmp_path).read(NAME, range(4)), VIEWS, **ERRORS)


@pytest.mark.parametrize("write_model", [write_binary_model, write_text_model])
def test_of_several_models_the_largest_is_read_and_said(
    tmp_path: Path, write_model: Callable[[Path, Sequence[RoomView]], None], caplog: pytest.LogCaptureFixture
):
    write_pictures(tmp_path, VIEWS)
    lost = replace(VIEWS[0], pose=np.full_like(VIEWS[0].pose, np.nan))
    write_model(tmp_path / "sparse/0", [lost, *VIEWS[1:2], lost, lost])
    write_model(tmp_path / "sparse/1", [lost, *VIEWS[1:]])
    write_model(tmp_path / "sparse/10", [*VIEWS[:2], lost, lost])
    dataset = Colmap(tmp_path)
    assert dataset.frame_names(tmp_path.name) == list(NAMES[1:])
    assert dataset.dropped_frames(tmp_path.name) == {"no pose": 1}
    assert "sparse holds 3 models" in caplog.text and "(0: 1, 1: 3, 10: 2) those of 1, the largest" in caplog.text
    caplog.clear()
    again = Colmap(tmp_path)  # from the index
    assert again.read(tmp_path.name, [0, 1]).images.shape[0] == 2 and again.extrinsics(tmp_path.name).shape[0] == 3
    assert caplog.text.count("sparse holds 3 models") == 1


def test_an_undistorted_folder_without_maps_yet_has_no_depth(tmp_path: Path):
    write_pictures(tmp_path, VIEWS)
    write_binary_model(tmp_path / "sparse", VIEWS)
    (tmp_path / "stereo/depth_maps").mkdir(parents=True)
    assert not Colmap(tmp_path).read(tmp_path.name, range(4)).depth.any()


def test_pictures_without_depth_or_registration_do_not_count(tmp_path: Path):
    write(tmp_path, VIEWS)
    (tmp_path / NAME / "depth" / NAMES[2]).unlink()
    write_image(tmp_path / NAME / "images/extra.jpg", VIEWS[0].picture)
    (tmp_path / NAME / "images/notes.txt").touch()
    dataset = Colmap(tmp_path)
    assert dataset.dropped_frames(NAME) == {"no pose": 1, "no depth": 1}
    assert dataset.frame_names(NAME) == [NAMES[0], NAMES[1], NAMES[3]]


@pytest.mark.parametrize(
    ("camera", "focal"),
    [
        ("SIMPLE_PINHOLE {0} {1} 55 {4} {5}", 55),
        ("SIMPLE_RADIAL {0} {1} 56 {4} {5} 0", 56),
        ("RADIAL {0} {1} 57 {4} {5} 0 0.0", 57),
        ("OPENCV {0} {1} 58 58 {4} {5} 0 0 0 0", 58),
        ("FULL_OPENCV {0} {1} 59 59 {4} {5} 0 0 0 0 0 0 0 0", 59),
    ],
)
def test_cameras_without_distortion_are_pinholes(tmp_path: Path, camera: str, focal: float):
    write_pictures(tmp_path, VIEWS)
    write_text_model(tmp_path / "sparse/0", VIEWS, camera)
    expected = INTRINSICS.copy()
    expected[0, 0] = expected[1, 1] = focal
    np.testing.assert_allclose(Colmap(tmp_path).read(tmp_path.name, [0]).intrinsics[0], expected, rtol=1e-6)


@pytest.mark.parametrize(
    "camera",
    [
        "FOV {0} {1} 55 55 {4} {5} 0.2",
        "SIMPLE_DIVISION {0} {1} 55 {4} {5} 0.1",
        "THIN_PRISM_FISHEYE {0} {1} 55 55 {4} {5} 0 0 0 0 0 0 0 0",
        "EQUIRECTANGULAR {0} {1} {0} {1}",
    ],
)
def test_distortion_that_is_not_opencvs_is_refused_by_name_with_the_mend(tmp_path: Path, camera: str):
    write_pictures(tmp_path, VIEWS)
    write_text_model(tmp_path / "sparse/0", VIEWS, camera)
    with pytest.raises(InputError, match=rf"cameras\.txt: camera 3 is {camera.split()[0]} .*colmap image_undistorter"):
        Colmap(tmp_path).num_frames(tmp_path.name)


@pytest.mark.parametrize(
    ("file", "old", "new", "complaint"),
    [
        ("cameras", "PINHOLE", "PINHOLES", r"cameras\.txt, line 2: expected a camera's number, one of COLMAP's models"),
        ("cameras", " 64 ", " inf ", r"cameras\.txt, line 2: expected a whole number"),
        ("cameras", " 64 ", " 64 1 ", r"cameras\.txt, line 2: expected a camera's number"),
        ("cameras", " 48 ", " 0 ", r"cameras\.txt, line 2: expected a width and height from 1"),
        ("cameras", "3 PIN", "4 PIN", r"cameras\.txt: no camera 3, which .*images\.txt names"),
        ("images", " 3 view10.png", "", r"images\.txt, line 5: expected a picture's number"),
        (
            "images",
            "view11.png\n\n",
            "view11.png\n",
            r"images\.txt, line 4: expected the keypoints of .* line above it",
        ),
        ("images", "view10.png", "/view10.png", r"images\.txt: '/view10\.png' is no file's name"),
        ("images", "view10.png", "view12.png", r"view12\.png: no such file, but .*images\.txt names it"),
    ],
)
def test_damaged_text_is_named(tmp_path: Path, file: str, old: str, new: str, complaint: str):
    write_pictures(tmp_path, VIEWS)
    write_text_model(tmp_path / "sparse/0", VIEWS)
    path = tmp_path / f"sparse/0/{file}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=complaint):
        Colmap(tmp_path).num_frames(tmp_path.name)


def test_another_depth_of_the_same_size_is_other_content(tmp_path: Path):
    """As a second run of the matching writes it: what was measured on the first is not taken for measured on it."""
    write_pictures(tmp_path, VIEWS)
    write_binary_model(tmp_path / "sparse/0", VIEWS)
    write_depth_map(tmp_path, NAMES[0], VIEWS[0].depth)
    path = tmp_path / f"stereo/depth_maps/{NAMES[0]}.geometric.bin"
    size, before = path.stat().st_size, Colmap(tmp_path).content_digest(tmp_path.name)
    write_depth_map(tmp_path, NAMES[0], VIEWS[0].depth)
    assert Colmap(tmp_path).content_digest(tmp_path.name) == before
    write_depth_map(tmp_path, NAMES[0], 1.1 * VIEWS[0].depth)
    assert path.stat().st_size == size and Colmap(tmp_path).content_digest(tmp_path.name) != before


@pytest.mark.parametrize("content", [b"", b"64&48&3&", b"64&48&1&" + bytes(64 * 48 * 4 - 1), b"0&48&1&", b"9" * 5000])
def test_damaged_depth_maps_are_named(tmp_path: Path, content: bytes):
    write_pictures(tmp_path, VIEWS)
    write_binary_model(tmp_path / "sparse/0", VIEWS)
    write_depth_map(tmp_path, NAMES[0], VIEWS[0].depth)
    path = tmp_path / f"stereo/depth_maps/{NAMES[0]}.geometric.bin"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{NAMES[0]}\.geometric\.bin: .* depth map"):
        Colmap(tmp_path).read(tmp_path.name, [0])


@pytest.mark.parametrize("slash", [b"/", b"\\"])
def test_pictures_in_folders_of_their_own_are_found(tmp_path: Path, slash: bytes):
    write(tmp_path, VIEWS)
    model = tmp_path / NAME / "sparse/0/images.bin"
    model.write_bytes(model.read_bytes().replace(b"view8.png", b"left" + slash + b"view8.png"))
    for kind in ("images", "depth"):
        folder = tmp_path / NAME / kind
        (folder / "left").mkdir()
        (folder / NAMES[0]).rename(folder / "left" / NAMES[0])
    dataset = Colmap(tmp_path)
    assert dataset.frame_names(NAME) == ["left/view8.png", *NAMES[1:]] and dataset.dropped_frames(NAME) == {}
    check_views(dataset.read(NAME, range(4)), VIEWS, **ERRORS)
