"""Co3Dv2: cameras, float bits, masks, set lists and damage."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from layouts.co3dv2 import (
    FRAME_NUMBERS,
    LANDSCAPE,
    LAYOUT,
    NAME,
    PORTRAIT,
    add,
    edit,
    views_of,
    write_depth,
    write_list,
    write_mask,
)
from layouts.co3dv2 import write_sequence as write_views
from room_views import check_views

from logvggt_jax.data.errors import EmptySplit
from logvggt_jax.data.readers import co3dv2
from logvggt_jax.data.readers.co3dv2 import Co3Dv2


def write_sequence(root: Path, name: str = NAME, size: tuple[int, int] = LANDSCAPE, kind: str = "ndc_isotropic"):
    views = views_of(size)
    write_views(root, views, name, kind, scale=1.0)
    return views


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path)
    return tmp_path


@pytest.fixture
def annotations(root: Path) -> Path:
    return root / "apple/frame_annotations.jgz"


@pytest.mark.parametrize("size", [LANDSCAPE, PORTRAIT])
@pytest.mark.parametrize("kind", ["ndc_isotropic", "ndc_norm_image_bounds"])
def test_cameras_of_both_forms_and_orientations_come_back(tmp_path: Path, size: tuple[int, int], kind: str):
    views = write_sequence(tmp_path, size=size, kind=kind)
    check_views(Co3Dv2(tmp_path).read(NAME, range(4)), views, picture_error=2.0, depth_error=LAYOUT.depth_error)


def test_a_viewpoint_without_a_format_is_normalised_by_both_edges(tmp_path: Path):
    views = write_sequence(tmp_path, kind="ndc_norm_image_bounds")
    path = tmp_path / "apple/frame_annotations.jgz"
    edit(path, lambda frame: frame["viewpoint"].pop("intrinsics_format"))
    intrinsics = Co3Dv2(tmp_path).read(NAME, [0]).intrinsics[0]
    np.testing.assert_allclose(intrinsics, views[0].intrinsics, rtol=1e-6)


def test_invalid_depth_becomes_zero(root: Path, annotations: Path):
    depth = np.full(LANDSCAPE, 2.5)
    depth[0, :5] = [0, -1, np.nan, np.inf, 2.5]
    write_depth(root / NAME / "depths/frame000009.jpg.geometric.png", depth)
    mask = np.full(LANDSCAPE, 255, np.uint8)
    mask[1, :3] = 0
    write_mask(root / NAME / "depth_masks/frame000009.png", mask)
    expected = np.full(LANDSCAPE, 2.5)
    expected[0, :4] = expected[1, :3] = 0
    np.testing.assert_array_equal(Co3Dv2(root).read(NAME, [0]).depth[0], expected)
    edit(annotations, lambda frame: frame["depth"].update(mask_path=None))
    expected[1, :3] = 2.5
    np.testing.assert_array_equal(Co3Dv2(root).read(NAME, [0]).depth[0], expected)


def test_sequences_need_good_cameras_and_a_folder(root: Path):
    scores = {"good": 0.51, "bad": 0.5, "unknown": None, "elsewhere": 0.9}
    entries = [{"sequence_name": name, "viewpoint_quality_score": score} for name, score in scores.items()]
    add(root / "apple/sequence_annotations.jgz", entries)
    for name in ("good", "bad", "unknown", "stray"):
        (root / "apple" / name).mkdir()
    assert Co3Dv2(root).sequences == (NAME, "apple/good")


def test_splits_hold_the_frames_of_the_set_lists(root: Path):
    for name in ("apple/2", "apple/3", "pear/1"):
        write_sequence(root, name)
    first = NAME.split("/")[1]
    # Frames are joined by their number, not by the one in the picture's name.
    train = [[first, number, "apple/any.jpg"] for number in (108, 20, 4)] + [["absent", 1, "x"]]
    write_list(root, "apple", "fewview_train", train=train, test=[["2", 4, "x"]])
    dev = {"test": [["2", number, "x"] for number in FRAME_NUMBERS], "train": [["3", 4, "x"]]}
    write_list(root, "apple", "fewview_dev", val=[[first, 4, "x"], ["2", 4, "x"], ["3", 25, "x"]], **dev)
    write_list(root, "apple", "fewview_test", test=[["3", 4, "x"]])
    write_list(root, "pear", "manyview_dev_0", train=[["1", 4, "x"]])
    names = {split: Co3Dv2(root, split).sequences for split in Co3Dv2.splits}
    assert names == {
        "train": (NAME,),
        "test": ("apple/2",),
        "val": ("apple/3",),
        "all": (NAME, "apple/2", "apple/3", "pear/1"),
    }
    assert Co3Dv2(root, "train").frame_names(NAME) == ["frame000009", "frame000003", "frame000001"]
    assert Co3Dv2(root, "val").frame_names("apple/3") == ["frame000007"]
    # The other splits' listings of the same sequence are not mixed up.
    assert Co3Dv2(root).num_frames(NAME) == 4
    assert Co3Dv2(root, "train").num_frames(NAME) == 3


def test_missing_and_damaged_set_lists_are_named(root: Path):
    with pytest.raises(FileNotFoundError, match=r"apple/set_lists: no such folder.*split='all'"):
        Co3Dv2(root, "train")
    write_list(root, "apple", "manyview_dev_0", train=[[NAME.split("/")[1], 4, "x"]])
    with pytest.raises(FileNotFoundError, match=r"name no sequence here for split 'train'.*split='all'"):
        Co3Dv2(root, "train")
    # Lists that name only what this copy does not have are no damage to the copy: nothing of it is held out.
    write_list(root, "apple", "fewview_dev", test=[["absent", 4, "x"]])
    with pytest.raises(EmptySplit, match=r"name no sequence here for split 'test'"):
        Co3Dv2(root, "test")
    with pytest.raises(FileNotFoundError) as unlisted:
        Co3Dv2(root, "train")
    assert not isinstance(unlisted.value, EmptySplit)
    for text in ("{", "{}", '{"test": [["a"]]}', '{"test": [["a", "b", "c"]]}'):
        (root / "apple/set_lists/set_lists_fewview_dev.json").write_text(text)
        with pytest.raises(ValueError, match=r"set_lists_fewview_dev\.json"):
            Co3Dv2(root, "test")


def test_a_category_is_parsed_once_for_all_of_its_sequences(root: Path, monkeypatch: pytest.MonkeyPatch):
    write_sequence(root, "apple/2")
    write_sequence(root, "pear/1")
    parsed = []
    parse = co3dv2.frame_annotations
    monkeypatch.setattr(
        co3dv2, "frame_annotations", lambda files, path, *a: (parsed.append(path), parse(files, path, *a))[1]
    )
    dataset = Co3Dv2(root)
    for name in (NAME, "apple/2", "pear/1"):
        assert dataset.num_frames(name) == 4
    assert [path.parent.name for path in parsed] == ["apple", "pear"]
    assert Co3Dv2(root).num_frames(NAME) == 4 and len(parsed) == 2
    # Worker processes get the listing, not the annotations.
    assert len(pickle.dumps(dataset)) < len(pickle.dumps(dataset.__dict__)) - 500
    # A change of the annotations is noticed, in the index and in what was parsed.
    write_sequence(root, "pear/2")
    edit(
        root / "pear/frame_annotations.jgz",
        lambda frame: frame.update(viewpoint=None) if frame["frame_number"] == 4 else None,
    )
    changed = Co3Dv2(root)
    assert changed.num_frames("pear/1") == 3 and changed.num_frames("pear/2") == 3 and len(parsed) == 3


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda frame: frame.update(viewpoint=None), "no pose"),
        (lambda frame: frame["viewpoint"]["T"].__setitem__(0, float("nan")), "no pose"),
        (lambda frame: frame["viewpoint"]["T"].__setitem__(1, -1e6), "no pose"),
        (lambda frame: frame.update(depth=None), "no depth"),
    ],
)
def test_frames_without_a_camera_or_depth_do_not_count(root: Path, annotations: Path, change, reason: str):
    edit(annotations, lambda frame: change(frame) if frame["frame_number"] == 20 else None)
    dataset = Co3Dv2(root)
    assert dataset.frame_names(NAME) == ["frame000009", "frame000007", "frame000001"]
    assert dataset.dropped_frames(NAME) == {reason: 1}
