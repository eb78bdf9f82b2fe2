"""WildRGB-D: numbers of frames, lists, resized copies and damage."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from layouts.wildrgbd import LAYOUT, SCENE
from room_views import check_views

from logvggt_jax.data.readers.wildrgbd import WildRGBD


def write_lists(category: Path, nvs: list[int], camera: list[int]) -> None:
    for name, train in (("nvs_list.json", nvs), ("camera_eval_list.json", camera)):
        text = json.dumps({"train": [f"scenes/scene_{number:03d}" for number in train], "val": ["scenes/scene_002"]})
        (category / name).write_text(text)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, LAYOUT.views)
    return tmp_path


@pytest.fixture
def scene(root: Path) -> Path:
    return root / SCENE


def edited_poses(scene: Path, line: int, text: str | None) -> None:
    lines = (scene / "cam_poses.txt").read_text().splitlines()
    lines[line : line + 1] = [] if text is None else [text]
    (scene / "cam_poses.txt").write_text("\n".join(lines))


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
    check_views(frames, LAYOUT.views, picture_error=0, depth_error=0.00051)


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
    np.testing.assert_allclose(dataset.extrinsics("apple/scene_007")[1], LAYOUT.views[3].extrinsics, atol=1e-5)


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


def test_missing_and_damaged_lists_are_named(root: Path):
    with pytest.raises(FileNotFoundError, match=r"apple/nvs_list\.json.*split='all'"):
        WildRGBD(root, "train")
    write_lists(root / "apple", [7], [7])
    for text in ("[]", "{}", '{"train": ["scene_007"]}', "{"):
        (root / "apple/camera_eval_list.json").write_text(text)
        with pytest.raises(ValueError, match=r"camera_eval_list\.json"):
            WildRGBD(root, "test")
