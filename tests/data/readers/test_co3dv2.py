"""Co3Dv2: the analytic room in the set's files comes back; cameras, float bits, masks, set lists and damage."""

from __future__ import annotations

import gzip
import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic_room import pinhole
from room_views import check_views, room_views

from logvggt_jax.data.errors import EmptySplit
from logvggt_jax.data.readers import co3dv2
from logvggt_jax.data.readers.co3dv2 import Co3Dv2

LANDSCAPE, PORTRAIT = (48, 64), (64, 48)
NAME = "apple/110_13051_23361"
# Neither the order of the list, nor that of the file names, is the order in time.
FILE_NUMBERS, FRAME_NUMBERS = (9, 3, 7, 1), (4, 20, 25, 108)


def normalised_camera(pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], kind: str) -> dict:
    """A viewpoint, by PyTorch3D's documentation: row vectors, x left, y up, coordinates of +1 at the left and upper
    border (of the shorter edge), pixels from 0 to W."""
    axes = np.diag([-1.0, -1.0, 1.0, 1.0])
    world_to_view = axes @ np.linalg.inv(pose)
    height, width = size
    scale = np.array([min(size) / 2] * 2 if kind == "ndc_isotropic" else [width / 2, height / 2])
    centre = np.array([intrinsics[0, 2] + 0.5, intrinsics[1, 2] + 0.5])
    return {
        "R": world_to_view[:3, :3].T.tolist(),
        "T": world_to_view[:3, 3].tolist(),
        "focal_length": (np.array([intrinsics[0, 0], intrinsics[1, 1]]) / scale).tolist(),
        "principal_point": (-(centre - np.array([width, height]) / 2) / scale).tolist(),
        "intrinsics_format": kind,
    }


def write_depth(path: Path, depth: np.ndarray) -> None:
    cv2.imwrite(str(path), np.asarray(depth, np.float16).view(np.uint16))


def write_gzip(path: Path, content: object) -> None:
    path.write_bytes(gzip.compress(json.dumps(content).encode()))


def read_gzip(path: Path) -> list:
    return json.loads(gzip.decompress(path.read_bytes()))


def write_sequence(root: Path, name: str = NAME, size=LANDSCAPE, kind: str = "ndc_isotropic", scale: float = 1.0):
    """Writes one sequence's files and adds it to its category's annotations; returns the views in time order."""
    category, sequence = name.split("/")
    folder = root / name
    for part in ("images", "depths", "masks", "depth_masks"):
        (folder / part).mkdir(parents=True)
    views = room_views(4, pinhole(size, 50.0, (size[1] / 2 + 1.25, size[0] / 2 - 2.5)), size)
    frames = []
    for seen, file_number, frame_number in zip(views, FILE_NUMBERS, FRAME_NUMBERS, strict=True):
        stem = f"frame{file_number:06d}"
        image, depth = f"{name}/images/{stem}.jpg", f"{name}/depths/{stem}.jpg.geometric.png"
        depth_mask = f"{name}/depth_masks/{stem}.png"
        cv2.imwrite(str(root / image), seen.picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 99])
        write_depth(root / depth, seen.depth / scale)
        cv2.imwrite(str(root / depth_mask), np.full(size, 255, np.uint8), [cv2.IMWRITE_PNG_BILEVEL, 1])
        frames.append(
            {
                "sequence_name": sequence,
                "frame_number": frame_number,
                "frame_timestamp": frame_number / 10,
                "image": {"path": image, "size": list(size)},
                "depth": {"path": depth, "scale_adjustment": scale, "mask_path": depth_mask},
                "mask": {"path": f"{name}/masks/{stem}.png", "mass": 100.0},
                "viewpoint": normalised_camera(seen.pose, seen.intrinsics, size, kind),
                "meta": {"frame_type": "train", "frame_splits": []},
            }
        )
    add(root / category / "frame_annotations.jgz", frames[2:] + frames[:2])
    quality = {"sequence_name": sequence, "category": category, "viewpoint_quality_score": 0.9}
    add(root / category / "sequence_annotations.jgz", [quality])
    return views


def add(path: Path, entries: list) -> None:
    write_gzip(path, (read_gzip(path) if path.exists() else []) + entries)


def edit(path: Path, change) -> None:
    """Applies `change` to every entry of an annotation file."""
    entries = read_gzip(path)
    for entry in entries:
        change(entry)
    write_gzip(path, entries)


def write_list(root: Path, category: str, name: str, **parts: list) -> None:
    folder = root / category / "set_lists"
    folder.mkdir(exist_ok=True)
    content = {"train": [], "val": [], "test": [], **parts}
    (folder / f"set_lists_{name}.json").write_text(json.dumps(content))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path)
    return tmp_path


@pytest.fixture
def annotations(root: Path) -> Path:
    return root / "apple/frame_annotations.jgz"


@pytest.mark.parametrize("size", [LANDSCAPE, PORTRAIT])
@pytest.mark.parametrize("kind", ["ndc_isotropic", "ndc_norm_image_bounds"])
def test_the_room_comes_back(tmp_path: Path, size: tuple[int, int], kind: str):
    views = write_sequence(tmp_path, size=size, kind=kind, scale=1.5)
    dataset = Co3Dv2(tmp_path)
    assert dataset.sequences == (NAME,)
    assert dataset.frame_names(NAME) == ["frame000009", "frame000003", "frame000007", "frame000001"]
    frames = dataset.read(NAME, range(4))
    assert not frames.metric
    # Half floats between 2 and 4 are 1/512 apart.
    check_views(frames, views, picture_error=2.0, depth_error=0.003)
    assert dataset.dropped_frames(NAME) == {}


def test_a_viewpoint_without_a_format_is_normalised_by_both_edges(tmp_path: Path):
    views = write_sequence(tmp_path, kind="ndc_norm_image_bounds")
    path = tmp_path / "apple/frame_annotations.jgz"
    edit(path, lambda frame: frame["viewpoint"].pop("intrinsics_format"))
    intrinsics = Co3Dv2(tmp_path).read(NAME, [0]).intrinsics[0]
    np.testing.assert_allclose(intrinsics, views[0].intrinsics, rtol=1e-6)
    edit(path, lambda frame: frame["viewpoint"].update(intrinsics_format="pixels"))
    with pytest.raises(ValueError, match=r"frame_annotations\.jgz.*'pixels'"):
        Co3Dv2(tmp_path).num_frames(NAME)


def test_invalid_depth_becomes_zero(root: Path, annotations: Path):
    depth = np.full(LANDSCAPE, 2.5)
    depth[0, :5] = [0, -1, np.nan, np.inf, 2.5]
    write_depth(root / NAME / "depths/frame000009.jpg.geometric.png", depth)
    mask = np.full(LANDSCAPE, 255, np.uint8)
    mask[1, :3] = 0
    cv2.imwrite(str(root / NAME / "depth_masks/frame000009.png"), mask, [cv2.IMWRITE_PNG_BILEVEL, 1])
    expected = np.full(LANDSCAPE, 2.5)
    expected[0, :4] = expected[1, :3] = 0
    np.testing.assert_array_equal(Co3Dv2(root).read(NAME, [0]).depth[0], expected)
    edit(annotations, lambda frame: frame["depth"].update(mask_path=None))
    expected[1, :3] = 2.5
    np.testing.assert_array_equal(Co3Dv2(root).read(NAME, [0]).depth[0], expected)
    write_depth(root / NAME / "depths/frame000009.jpg.geometric.png", np.zeros(LANDSCAPE))
    assert (Co3Dv2(root).read(NAME, [0]).depth == 0).all()


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


@pytest.mark.parametrize(
    "name",
    ["images/frame000003.jpg", "depths/frame000003.jpg.geometric.png", "depth_masks/frame000003.png"],
)
def test_a_missing_file_is_named(root: Path, name: str):
    (root / NAME / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{NAME}/{name}: no such file"):
        Co3Dv2(root).num_frames(NAME)


@pytest.mark.parametrize("name", ["frame_annotations.jgz", "sequence_annotations.jgz"])
def test_damaged_annotations_are_named(root: Path, name: str):
    path = root / "apple" / name
    whole = path.read_bytes()
    for content in (
        whole[: len(whole) // 2],
        b"",
        b"[]",
        gzip.compress(b"{"),
        gzip.compress(b"{}"),
        gzip.compress(b"[3]"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"apple/{name}: .*fetch it again"):
            Co3Dv2(root).num_frames(NAME)
    path.unlink()
    if name == "sequence_annotations.jgz":
        with pytest.raises(FileNotFoundError, match=f"apple/{name}: no such file"):
            Co3Dv2(root)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda frame: frame["viewpoint"].update(R=np.diag([1, 1, -1]).tolist()), r"images/frame000\d+\.jpg: .*rigid"),
        (lambda frame: frame["viewpoint"].update(T=[1, 2]), "fetch it again"),
        (lambda frame: frame["viewpoint"].pop("focal_length"), "focal_length"),
        (lambda frame: frame.pop("image"), "image"),
    ],
)
def test_a_damaged_annotation_is_named(root: Path, annotations: Path, change, complaint: str):
    edit(annotations, change)
    with pytest.raises(ValueError, match=rf"frame_annotations\.jgz.*{complaint}"):
        Co3Dv2(root).num_frames(NAME)


def test_a_sequence_without_annotations_is_named(root: Path, annotations: Path):
    write_gzip(annotations, [])
    with pytest.raises(ValueError, match=f"{NAME}: no frame of Co3Dv2 counts"):
        Co3Dv2(root).num_frames(NAME)


def test_pictures_that_do_not_belong_together_are_named(root: Path, annotations: Path):
    cv2.imwrite(str(root / NAME / "depth_masks/frame000009.png"), np.ones((24, 32), np.uint8))
    with pytest.raises(ValueError, match=r"depth_masks/frame000009\.png: size \(24, 32\)"):
        Co3Dv2(root).read(NAME, [0])
    cv2.imwrite(str(root / NAME / "images/frame000003.jpg"), np.zeros((*PORTRAIT, 3), np.uint8))
    with pytest.raises(ValueError, match=r"images/frame000003\.jpg: a picture of 48 x 64"):
        Co3Dv2(root).read(NAME, [1])
    edit(annotations, lambda frame: frame["viewpoint"].update(focal_length=[1e-3, 1e-3]))
    with pytest.raises(ValueError, match=r"frame000007\.jpg: intrinsics fx=0\.024"):
        Co3Dv2(root).read(NAME, [2])
