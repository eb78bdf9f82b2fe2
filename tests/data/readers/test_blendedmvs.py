"""BlendedMVS: the analytic room in the set's files comes back; pairs, lists and damage."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_views import RoomView, check_views, room_views

from logvggt_jax.data.formats.pfm import read_pfm
from logvggt_jax.data.readers.blendedmvs import BlendedMVS

SIZE = (48, 64)
INTRINSICS = pinhole(SIZE, 50.0, (30.5, 25.0))
SCENE, OTHER, THIRD = "5bfe5ae0fe0ea555e6a969ca", "58eaf1513353456af3a1682a", "5c34529873a8df509ae57b58"
PAIRS = "4\n0\n2 1 900.5 2 30.25 \n1\n1 0 900.5 \n2\n3 1 10 3 70.5 0 30.25 \n7\n0 \n"


def pfm_bytes(depth: np.ndarray, *, big_endian: bool = False) -> bytes:
    header = f"Pf\n{depth.shape[1]} {depth.shape[0]}\n{'1.000000' if big_endian else '-1.000000'}\n"
    return header.encode() + np.flipud(depth).astype(">f4" if big_endian else "<f4").tobytes()


def camera_text(pose: np.ndarray, intrinsics: np.ndarray, depth_range: str) -> str:
    def rows(matrix: np.ndarray) -> str:
        return "".join(" ".join(f"{value:.9g}" for value in row) + " \n" for row in matrix)

    return f"extrinsic\n{rows(np.linalg.inv(pose))}\nintrinsic\n{rows(intrinsics)}\n{depth_range}\n"


def write_frame(scene: Path, name: str, seen: RoomView, *, depth_range: str = "1.5 0.1") -> None:
    for folder in ("blended_images", "cams", "rendered_depth_maps"):
        (scene / folder).mkdir(parents=True, exist_ok=True)
    for suffix, picture in (("", seen.picture), ("_masked", 0 * seen.picture)):
        path = scene / "blended_images" / f"{name}{suffix}.jpg"
        cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 99])
    (scene / "cams" / f"{name}_cam.txt").write_text(camera_text(seen.pose, seen.intrinsics, depth_range))
    (scene / "rendered_depth_maps" / f"{name}.pfm").write_bytes(pfm_bytes(seen.depth))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """One scene of four frames (numbers 0, 1, 2, 7) and its pairs."""
    # The depth range at the end has two to four numbers; some are negative.
    ranges = ("1.5 0.1", "-1.5 0.1 128", "1.5 0.1 128 9.9", "1.5 0.1")
    for number, seen, depth_range in zip((0, 1, 2, 7), room_views(4, INTRINSICS, SIZE), ranges, strict=True):
        write_frame(tmp_path / SCENE, f"{number:08d}", seen, depth_range=depth_range)
    (tmp_path / SCENE / "cams" / "pair.txt").write_text(PAIRS)
    (tmp_path / "textured_meshes").mkdir()
    return tmp_path


def test_the_room_comes_back(root: Path):
    dataset = BlendedMVS(root)
    assert dataset.sequences == (SCENE,)
    assert dataset.frame_names(SCENE) == ["00000000", "00000001", "00000002", "00000007"]
    frames = dataset.read(SCENE, range(4))
    assert not frames.metric
    check_views(frames, room_views(4, INTRINSICS, SIZE), picture_error=2.0, depth_error=1e-6)
    assert dataset.dropped_frames(SCENE) == {}


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


def test_holes_of_the_mesh_are_invalid_and_an_empty_frame_is_read(root: Path):
    depth = np.full(SIZE, 2.5, np.float32)
    depth[0, :4] = [0, -1, np.nan, np.inf]
    maps = root / SCENE / "rendered_depth_maps"
    (maps / "00000001.pfm").write_bytes(pfm_bytes(depth))
    (maps / "00000002.pfm").write_bytes(pfm_bytes(np.zeros(SIZE)))
    frames = BlendedMVS(root).read(SCENE, [1, 2])
    np.testing.assert_array_equal(frames.depth[0, 0, :6], np.float32([0, 0, 0, 0, 2.5, 2.5]))
    assert (frames.depth[1] == 0).all()


def test_covisibility_is_in_frame_indices_with_the_best_first(root: Path):
    dataset = BlendedMVS(root)
    # Image 3 is not there, image 7 is frame 3 and has no neighbours.
    assert dataset.covisibility(SCENE) == {
        0: [(1, 900.5), (2, 30.25)],
        1: [(0, 900.5)],
        2: [(0, 30.25), (1, 10.0)],
    }
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
    write_frame(root / OTHER, "00000000", room_views(1, INTRINSICS, SIZE)[0])
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
    with pytest.raises(ValueError, match="no split 'test'"):
        BlendedMVS(root, "test")


@pytest.mark.parametrize(
    "name", ["blended_images/00000001.jpg", "cams/00000001_cam.txt", "rendered_depth_maps/00000001.pfm"]
)
def test_a_missing_file_is_named(root: Path, name: str):
    (root / SCENE / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{name}: no such file"):
        BlendedMVS(root).num_frames(SCENE)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda text: text.replace("intrinsic\n", "intrinsic\n1 "), "got 32 words"),
        (lambda text: text[: len(text) // 2], "expected 'extrinsic'"),
        (lambda text: text.replace("intrinsic\n", "intrinsic\nx", 2), "expected numbers"),
        (lambda text: text.replace("extrinsic\n", "extrinsic\n9", 1), "rigid"),
    ],
)
def test_a_damaged_camera_is_named(root: Path, change, complaint: str):
    path = root / SCENE / "cams/00000002_cam.txt"
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=rf"00000002_cam\.txt.*({complaint})"):
        BlendedMVS(root).num_frames(SCENE)


def test_a_lost_pose_drops_the_frame_and_is_counted(root: Path):
    lost = np.full((4, 4), np.nan)
    path = root / SCENE / "cams/00000001_cam.txt"
    path.write_text(camera_text(lost, INTRINSICS, "1 0.1"))
    dataset = BlendedMVS(root)
    assert dataset.frame_names(SCENE) == ["00000000", "00000002", "00000007"]
    assert dataset.dropped_frames(SCENE) == {"no pose": 1}
    assert dataset.covisibility(SCENE) == {0: [(1, 30.25)], 1: [(0, 30.25)]}


def test_absurd_intrinsics_are_named(root: Path):
    seen = room_views(1, INTRINSICS, SIZE)[0]
    absurd = camera_text(seen.pose, np.diag([0.5, 0.5, 1]), "1 0.1")
    (root / SCENE / "cams/00000000_cam.txt").write_text(absurd)
    with pytest.raises(ValueError, match=r"00000000\.jpg: intrinsics fx=0\.5"):
        BlendedMVS(root).read(SCENE, [0])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (pfm_bytes(np.ones(SIZE))[:-8], "12288 bytes after its header, got 12280"),
        (pfm_bytes(np.ones(SIZE)).replace(b"Pf", b"PF", 1), "single-channel"),
        (b"Pf\n0 0\n-1\n", "0 x 0"),
        (b"", "single-channel"),
        (pfm_bytes(np.ones((40, 64))), r"size \(40, 64\) differs"),
    ],
)
def test_damaged_depth_is_named(root: Path, content: bytes, complaint: str):
    (root / SCENE / "rendered_depth_maps/00000000.pfm").write_bytes(content)
    with pytest.raises(ValueError, match=rf"00000000\.pfm.*{complaint}"):
        BlendedMVS(root).read(SCENE, [0])


def test_an_empty_scene_is_named(root: Path):
    for folder in ("blended_images", "cams", "rendered_depth_maps"):
        (root / OTHER / folder).mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=rf"{OTHER}/blended_images: no files like 00000000\.jpg"):
        BlendedMVS(root).num_frames(OTHER)
    (root / OTHER / "blended_images").rmdir()
    with pytest.raises(FileNotFoundError, match="blended_images: no such folder"):
        BlendedMVS(root).num_frames(OTHER)
