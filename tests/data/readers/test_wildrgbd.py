"""WildRGB-D: the analytic room in the set's files comes back; lists, resized copies and damage."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import camera_to_world, pinhole
from room_views import check_views, room_views

from logvggt_jax.data.readers.wildrgbd import WildRGBD

SIZE = (64, 48)
INTRINSICS = np.array([[52.0, 0, 22.5], [0, 53.0, 33.0], [0, 0, 1]])


def write_metadata(scene: Path, intrinsics: np.ndarray, size: tuple[int, int]) -> None:
    columns = [intrinsics[row][column] for column in range(3) for row in range(3)]
    (scene / "metadata").write_text(json.dumps({"w": size[1], "h": size[0], "K": columns, "fps": 30}))


def write_scene(scene: Path, count: int = 4) -> None:
    for folder in ("rgb", "depth", "masks"):
        (scene / folder).mkdir(parents=True)
    lines = []
    for index, seen in enumerate(room_views(count, INTRINSICS, SIZE)):
        cv2.imwrite(str(scene / f"rgb/{index:05d}.png"), seen.picture[..., ::-1])
        cv2.imwrite(str(scene / f"depth/{index:05d}.png"), np.rint(seen.depth * 1000).astype(np.uint16))
        lines.append(" ".join([str(index), *(f"{value:.9g}" for value in seen.pose.ravel())]))
    (scene / "cam_poses.txt").write_text("\n".join(lines) + "\n")
    write_metadata(scene, INTRINSICS, SIZE)


def write_lists(category: Path, nvs: list[int], camera: list[int]) -> None:
    for name, train in (("nvs_list.json", nvs), ("camera_eval_list.json", camera)):
        text = json.dumps({"train": [f"scenes/scene_{number:03d}" for number in train], "val": ["scenes/scene_002"]})
        (category / name).write_text(text)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_scene(tmp_path / "apple/scenes/scene_007")
    (tmp_path / "apple" / "types.json").write_text("{}")
    return tmp_path


@pytest.fixture
def scene(root: Path) -> Path:
    return root / "apple/scenes/scene_007"


def edited_poses(scene: Path, line: int, text: str | None) -> None:
    lines = (scene / "cam_poses.txt").read_text().splitlines()
    lines[line : line + 1] = [] if text is None else [text]
    (scene / "cam_poses.txt").write_text("\n".join(lines))


def test_the_room_comes_back(root: Path):
    dataset = WildRGBD(root)
    assert dataset.sequences == ("apple/scene_007",)
    frames = dataset.read("apple/scene_007", range(4))
    assert frames.metric
    check_views(frames, room_views(4, INTRINSICS, SIZE), picture_error=0, depth_error=0.00051)
    assert dataset.dropped_frames("apple/scene_007") == {}


def test_zero_depth_is_invalid_and_an_empty_frame_is_read(root: Path, scene: Path):
    cv2.imwrite(str(scene / "depth/00001.png"), np.zeros(SIZE, np.uint16))
    assert (WildRGBD(root).read("apple/scene_007", [1]).depth == 0).all()


def test_frames_are_ordered_by_number_and_poses_found_by_it(root: Path, scene: Path):
    # A line of another order, and numbers of six digits.
    lines = (scene / "cam_poses.txt").read_text().splitlines()
    lines[3] = lines[3].replace("3 ", "100000 ", 1)
    (scene / "cam_poses.txt").write_text("\n".join(reversed(lines)))
    for folder in ("rgb", "depth"):
        (scene / folder / "00003.png").rename(scene / folder / "100000.png")
    dataset = WildRGBD(root)
    assert dataset.frame_names("apple/scene_007") == ["00000", "00001", "00002", "100000"]
    frames = dataset.read("apple/scene_007", range(4))
    check_views(frames, room_views(4, INTRINSICS, SIZE), picture_error=0, depth_error=0.00051)


def test_resized_copies_have_intrinsics_of_their_size_and_turned_ones_are_refused(root: Path, scene: Path):
    for path in (*(scene / "rgb").iterdir(), *(scene / "depth").iterdir()):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])
    intrinsics = WildRGBD(root).read("apple/scene_007", [0]).intrinsics[0]
    np.testing.assert_allclose(intrinsics, [[26, 0, 11.0], [0, 26.5, 16.25], [0, 0, 1]], rtol=1e-6)
    path = scene / "rgb/00000.png"
    cv2.imwrite(str(path), cv2.imread(str(path)).transpose(1, 0, 2))
    with pytest.raises(ValueError, match=r"rgb/00000\.png.*32 x 24 does not have the shape of its calibration"):
        WildRGBD(root).read("apple/scene_007", [0])


def test_frames_without_a_pose_do_not_count(root: Path, scene: Path):
    edited_poses(scene, 2, None)
    edited_poses(scene, 0, " ".join(["0", *["nan"] * 16]))
    dataset = WildRGBD(root)
    assert dataset.frame_names("apple/scene_007") == ["00001", "00003"]
    assert dataset.dropped_frames("apple/scene_007") == {"no pose": 2}
    frames = dataset.read("apple/scene_007", [1])
    np.testing.assert_allclose(frames.extrinsics[0], np.linalg.inv(camera_to_world(3)), atol=1e-5)


def test_training_scenes_are_those_of_both_lists_and_the_rest_is_for_tests(root: Path):
    for number in (2, 10, 1000):
        (root / f"apple/scenes/scene_{number:03d}").mkdir()
    for number in (1, 257):
        (root / f"box/scenes/scene_{number:03d}").mkdir(parents=True)
    write_lists(root / "apple", nvs=[2, 7, 10, 11], camera=[7, 10, 11, 1000])
    write_lists(root / "box", nvs=[1, 257], camera=[1, 257])
    names = ["apple/scene_002", "apple/scene_007", "apple/scene_010", "apple/scene_1000", "box/scene_001"]
    assert WildRGBD(root).sequences == tuple(names)
    # Scene 11 is listed, but not in this copy.
    assert WildRGBD(root, "train").sequences == ("apple/scene_007", "apple/scene_010", "box/scene_001")
    assert WildRGBD(root, "test").sequences == ("apple/scene_002", "apple/scene_1000")
    with pytest.raises(ValueError, match="no split 'val'"):
        WildRGBD(root, "val")


def test_missing_and_damaged_lists_are_named(root: Path):
    with pytest.raises(FileNotFoundError, match=r"apple/nvs_list\.json.*split='all'"):
        WildRGBD(root, "train")
    write_lists(root / "apple", [7], [7])
    for text in ("[]", "{}", '{"train": ["scene_007"]}', "{"):
        (root / "apple/camera_eval_list.json").write_text(text)
        with pytest.raises(ValueError, match=r"camera_eval_list\.json"):
            WildRGBD(root, "test")


@pytest.mark.parametrize("name", ["rgb/00001.png", "depth/00001.png", "metadata", "cam_poses.txt"])
def test_a_missing_file_is_named(root: Path, scene: Path, name: str):
    (scene / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"scene_007/{name}: no such file"):
        WildRGBD(root).num_frames("apple/scene_007")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1 0 0 0", "expected 17 numbers, got 4"),
        ("1.5 " + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "frame number"),
        ("1 " + "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "rigid"),
        ("1 " + "1 0 0 0 0 -1 0 0 0 0 1 0 0 0 0 1", "rigid"),
    ],
)
def test_a_bad_pose_is_named_with_its_line(root: Path, scene: Path, text: str, complaint: str):
    edited_poses(scene, 1, text)
    with pytest.raises(ValueError, match=rf"cam_poses\.txt, line 2: .*{complaint}"):
        WildRGBD(root).num_frames("apple/scene_007")


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"w": 4, "h": 3}', '{"w": 4, "h": 3, "K": [1, 2]}', '{"w": 0, "h": 3, "K": [1,0,0,0,1,0,0,0,1]}'],
)
def test_a_bad_calibration_is_named(root: Path, scene: Path, text: str):
    (scene / "metadata").write_text(text)
    with pytest.raises(ValueError, match=r"scene_007/metadata: .*fetch it again"):
        WildRGBD(root).num_frames("apple/scene_007")


def test_row_major_intrinsics_are_refused_as_absurd(root: Path, scene: Path):
    write_metadata(scene, INTRINSICS.T, SIZE)
    with pytest.raises(ValueError, match=r"00000\.png: intrinsics"):
        WildRGBD(root).read("apple/scene_007", [0])
    write_metadata(scene, pinhole(SIZE, 1e6), SIZE)
    with pytest.raises(ValueError, match=r"00000\.png: intrinsics fx=1e\+06"):
        WildRGBD(root).read("apple/scene_007", [0])


def test_damaged_pictures_are_named(root: Path, scene: Path):
    cv2.imwrite(str(scene / "depth/00000.png"), np.zeros((32, 48), np.uint16))
    with pytest.raises(ValueError, match=r"depth/00000\.png: size \(32, 48\)"):
        WildRGBD(root).read("apple/scene_007", [0])
    path = scene / "rgb/00001.png"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"rgb/00001\.png: truncated"):
        WildRGBD(root).read("apple/scene_007", [1])


def test_a_root_without_scenes_is_refused(tmp_path: Path):
    (tmp_path / "apple").mkdir()
    with pytest.raises(FileNotFoundError, match="no sequences of WildRGB-D"):
        WildRGBD(tmp_path)
