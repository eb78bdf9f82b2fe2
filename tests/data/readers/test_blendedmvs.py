"""BlendedMVS: float maps, holes, pairs, lists and damage."""

from pathlib import Path

import numpy as np
import pytest
from layouts.blendedmvs import LAYOUT, SCENE, camera_text, pfm_bytes, write_frame
from layouts.layout import VIEWS
from room_views import SIZE

from logvggt_jax.data.formats.pfm import read_pfm
from logvggt_jax.data.readers.blendedmvs import BlendedMVS

OTHER, THIRD = "58eaf1513353456af3a1682a", "5c34529873a8df509ae57b58"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """One scene of four frames (numbers 0, 1, 2, 7) and its pairs."""
    LAYOUT.write(tmp_path, VIEWS)
    return tmp_path


def test_float_maps_are_flipped_and_of_either_byte_order(tmp_path: Path):
    depth = np.random.default_rng(0).uniform(1, 9, (5, 7)).astype(np.float32)
    for big_endian in (False, True):
        (tmp_path / "a.pfm").write_bytes(pfm_bytes(depth, big_endian=big_endian))
        read = read_pfm(tmp_path / "a.pfm")
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read, depth)


def test_a_float_map_may_begin_with_bytes_that_look_like_white_space(tmp_path: Path):
    numbers = np.frombuffer(b"\n\n  " * 4, "<f4").reshape(2, 2)
    (tmp_path / "a.pfm").write_bytes(pfm_bytes(numbers))
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), numbers)


def test_holes_of_the_mesh_are_invalid(root: Path):
    depth = np.full(SIZE, 2.5, np.float32)
    depth[0, :4] = [0, -1, np.nan, np.inf]
    maps = root / SCENE / "rendered_depth_maps"
    (maps / "00000001.pfm").write_bytes(pfm_bytes(depth))
    frames = BlendedMVS(root).read(SCENE, [1])
    np.testing.assert_array_equal(frames.depth[0, 0, :6], np.float32([0, 0, 0, 0, 2.5, 2.5]))


def test_covisibility_is_in_frame_indices_with_the_best_first(root: Path):
    dataset = BlendedMVS(root)
    # Image 3 is not there, image 7 is frame 3 and has no neighbours.
    assert dataset.covisibility(SCENE) == {0: [(1, 900.5), (2, 30.25)], 1: [(0, 900.5)], 2: [(0, 30.25), (1, 10.0)]}
    assert [dataset.neighbours(SCENE, index) for index in range(4)] == [[1, 2], [0], [0, 1], []]
    (root / SCENE / "cams" / "pair.txt").write_text("1\n7\n1 2 5.5\n")
    assert dataset.covisibility(SCENE) == {3: [(2, 5.5)]}


@pytest.mark.parametrize("text", ["", "2\n0\n1 1 5.0\n", "1\n0\n2 1 5.0\n", "1\n0\n1 1 5.0 9\n", "1\n0\n1 x 5.0\n"])
def test_damaged_pairs_are_named(root: Path, text: str):
    path = root / SCENE / "cams" / "pair.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"pair\.txt: expected .*fetch the file again"):
        BlendedMVS(root).covisibility(SCENE)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"pair\.txt"):
        BlendedMVS(root).covisibility(SCENE)


@pytest.mark.parametrize("place", [".", "project_lists"])
def test_splits_follow_the_lists(root: Path, place: str):
    write_frame(root / OTHER, "00000000", VIEWS[0])
    (root / place).mkdir(exist_ok=True)
    (root / place / "BlendedMVG_training.txt").write_text(f"{SCENE}\n{THIRD}\n")
    assert BlendedMVS(root).sequences == (OTHER, SCENE)
    assert BlendedMVS(root, "train").sequences == (SCENE,)
    with pytest.raises(FileNotFoundError, match=r"validation_list\.txt.*split='all'"):
        BlendedMVS(root, "val")
    (root / place / "validation_list.txt").write_text(OTHER)
    assert BlendedMVS(root, "val").sequences == (OTHER,)
    (root / place / "validation_list.txt").write_text("den\n")
    with pytest.raises(ValueError, match=r"validation_list\.txt.*'den'"):
        BlendedMVS(root, "val")


def test_covisibility_passes_over_frames_that_do_not_count(root: Path):
    (root / SCENE / "cams/00000001_cam.txt").write_text(camera_text(np.full((4, 4), np.nan)))
    dataset = BlendedMVS(root)
    assert dataset.covisibility(SCENE) == {0: [(1, 30.25)], 1: [(0, 30.25)]}


def test_an_empty_scene_is_named(root: Path):
    for folder in ("blended_images", "cams", "rendered_depth_maps"):
        (root / OTHER / folder).mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=rf"{OTHER}/blended_images: no files like 00000000\.jpg"):
        BlendedMVS(root).num_frames(OTHER)
    (root / OTHER / "blended_images").rmdir()
    with pytest.raises(FileNotFoundError, match="blended_images: no such folder"):
        BlendedMVS(root).num_frames(OTHER)
