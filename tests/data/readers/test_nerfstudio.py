"""What only nerfstudio's form has: cameras of single frames, recordings without depth, a recording as the root."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layouts.nerfstudio import LAYOUT, NAME, NAMES

from logvggt_jax.data import open_dataset
from logvggt_jax.errors import InputError


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    LAYOUT.write(tmp_path, LAYOUT.views)
    return tmp_path / NAME


def edit(recording: Path, change: Callable[[dict], object]) -> None:
    path = recording / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_the_root_itself_may_be_the_recording(recording: Path):
    assert open_dataset("nerfstudio", recording).sequences == (NAME,)


def test_a_frames_own_camera_comes_before_the_one_for_all(recording: Path):
    before = open_dataset("nerfstudio", recording).read(NAME, [0, 1]).intrinsics
    # Frames are written in reverse: the last one is the first in order.
    edit(recording, lambda content: content["frames"][-1].update(fl_x=1.1 * content["fl_x"]))
    after = open_dataset("nerfstudio", recording).read(NAME, [0, 1]).intrinsics
    assert after[0, 0, 0] == pytest.approx(1.1 * before[0, 0, 0], rel=1e-6)
    np.testing.assert_array_equal(after[1], before[1])


def test_without_any_depth_frames_count_and_have_none(recording: Path):
    edit(recording, lambda content: [entry.pop("depth_file_path") for entry in content["frames"]])
    dataset = open_dataset("nerfstudio", recording)
    assert dataset.frame_names(NAME) == list(NAMES) and not dataset.read(NAME, [0]).depth.any()


def test_where_some_have_depth_those_without_do_not_count(recording: Path):
    edit(recording, lambda content: content["frames"][0].pop("depth_file_path"))
    dataset = open_dataset("nerfstudio", recording)
    assert dataset.num_frames(NAME) == 3 and dataset.dropped_frames(NAME) == {"no depth": 1}


def test_depth_is_scaled_as_its_poses_were(recording: Path):
    before = open_dataset("nerfstudio", recording).read(NAME, range(4)).depth
    edit(recording, lambda content: content.update(applied_scale=0.25, applied_transform=np.eye(4)[:3].tolist()))
    np.testing.assert_allclose(open_dataset("nerfstudio", recording).read(NAME, range(4)).depth, before / 4, rtol=1e-6)
    for scale in ("large", 0, float("nan"), None):
        edit(recording, lambda content, scale=scale: content.update(applied_scale=scale))
        with pytest.raises(InputError, match=r"transforms\.json: .*applied_scale"):
            open_dataset("nerfstudio", recording).num_frames(NAME)


def test_pictures_named_without_their_suffix_are_found(recording: Path):
    expected = open_dataset("nerfstudio", recording).read(NAME, range(4))
    edit(recording, lambda content: [e.update(file_path=e["file_path"][: -len(".png")]) for e in content["frames"]])
    (recording / "images/frame_8_mask.png").touch()
    dataset = open_dataset("nerfstudio", recording)
    assert dataset.frame_names(NAME) == list(NAMES)
    np.testing.assert_array_equal(dataset.read(NAME, range(4)).images, expected.images)
    (recording / "images/frame_9.jpg").touch()
    with pytest.raises(InputError, match=r"images/frame_9: no such file, but .*transforms\.json names it"):
        open_dataset("nerfstudio", recording).num_frames(NAME)


def test_a_picture_named_with_its_suffix_is_that_one_whatever_else_has_its_name(recording: Path):
    edit(recording, lambda content: content["frames"][0].update(file_path=content["frames"][0]["file_path"][:-4]))
    for name in NAMES:
        (recording / f"{name}.png").touch()  # of masks
    assert open_dataset("nerfstudio", recording).frame_names(NAME) == list(NAMES)


def test_names_with_the_slashes_of_windows_are_found(recording: Path):
    edit(
        recording,
        lambda content: [e.update(file_path=e["file_path"][2:].replace("/", "\\")) for e in content["frames"]],
    )
    assert open_dataset("nerfstudio", recording).frame_names(NAME) == list(NAMES)
    edit(recording, lambda content: content["frames"][0].update(file_path="..\\a.png"))
    with pytest.raises(InputError, match="is no file's name below"):
        open_dataset("nerfstudio", recording).num_frames(NAME)


def test_a_picture_that_is_named_twice_is_refused(recording: Path):
    edit(recording, lambda content: content["frames"].append(content["frames"][1]))
    with pytest.raises(InputError, match=r"transforms\.json: '\./images/frame_10\.png' is named twice"):
        open_dataset("nerfstudio", recording).num_frames(NAME)
