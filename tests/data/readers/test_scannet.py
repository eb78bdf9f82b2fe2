"""ScanNet: colour and depth of two sizes, both layouts, lost poses, splits, damage."""

from pathlib import Path

import numpy as np
import pytest
from layouts.layout import VIEWS
from layouts.scannet import LAYOUT, SCENE, write_prepared, write_scene
from room_views import SIZE, check_views, write_image

from logvggt_jax.data.readers.scannet import ScanNet

ERRORS = {"picture_error": LAYOUT.picture_error, "depth_error": LAYOUT.depth_error}


def lose(path: Path, row: int | None = None) -> None:
    """Lost tracking as the export writes it."""
    values = np.loadtxt(path)
    values[... if row is None else row] = -np.inf
    np.savetxt(path, values)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_scene(tmp_path / SCENE)
    write_scene(tmp_path / "scans_test/scene0707_00")
    return tmp_path


def test_colour_is_averaged_over_the_pixels_that_a_depth_pixel_covers(root: Path):
    v, u = np.indices((2 * SIZE[0], 2 * SIZE[1]))
    board = np.repeat((((u + v) % 2) * 200).astype(np.uint8)[..., None], 3, axis=2)
    write_image(root / SCENE / "color/8.jpg", board)
    image = ScanNet(root).read("scene0000_00", [0]).images[0]
    assert np.abs(image.astype(int) - 100).max() <= 5


def test_padded_numbers_are_read_also_beside_unpadded_ones(root: Path):
    for folder in ("color", "depth"):  # poses stay as they are
        for path in (root / SCENE / folder).iterdir():
            path.rename(path.with_name(f"{int(path.stem):06d}{path.suffix}"))
    scans = ScanNet(root)
    assert scans.frame_names("scene0000_00") == ["000008", "000009", "000010", "000011"]
    check_views(scans.read("scene0000_00", range(4)), VIEWS, **ERRORS)


@pytest.mark.parametrize("part", ["scannetv2", "."])
def test_other_folders_of_scenes_are_read(tmp_path: Path, part: str):
    write_scene(tmp_path / part / "scene0011_01")
    (tmp_path / "scans").mkdir()
    scans = ScanNet(tmp_path)
    assert scans.sequences == ("scene0011_01",)
    check_views(scans.read("scene0011_01", range(4)), VIEWS, **ERRORS)


def test_scenes_of_the_download_folder_are_read_where_they_were_exported_there(root: Path):
    write_scene(root / "scans/scene0011_01")
    sens = root / "scans/scene0000_00/scene0000_00.sens"  # exported to scans_train
    sens.parent.mkdir()
    sens.touch()
    assert ScanNet(root).sequences == ("scene0000_00", "scene0011_01", "scene0707_00")
    # Which of them are for training is not known without the lists.
    assert ScanNet(root, "train").sequences == ("scene0000_00",)


def test_the_prepared_form_comes_back(tmp_path: Path):
    scene = tmp_path / "scannetv2/scene0707_00"
    write_prepared(scene)
    scans = ScanNet(tmp_path)
    assert scans.sequences == ("scene0707_00/color_90",)
    name = scans.sequences[0]
    assert scans.frame_names(name) == [f"frame_{i:04d}" for i in range(4)]
    check_views(scans.read(name, range(4)), VIEWS, **ERRORS)
    lose(scene / "pose_90.txt", row=1)
    scans = ScanNet(tmp_path)
    assert scans.dropped_frames(name) == {"no pose": 1}
    check_views(scans.read(name, range(3)), [VIEWS[i] for i in (0, 2, 3)], **ERRORS)


def test_the_export_goes_before_what_was_prepared_from_it(root: Path):
    scene = root / "scans_test/scene0707_00"
    for name in ("color_90", "depth_90"):
        (scene / name).mkdir()
    assert ScanNet(root, "test").sequences == ("scene0707_00",)


def test_prepared_poses_of_another_count_are_named(tmp_path: Path):
    scene = tmp_path / "scene0707_00"
    write_prepared(scene, count=50)
    np.savetxt(scene / "pose_50.txt", np.loadtxt(scene / "pose_50.txt")[:3])
    with pytest.raises(ValueError, match=r"pose_50\.txt: expected 4 poses.*got 3 lines"):
        ScanNet(tmp_path).num_frames("scene0707_00/color_50")
    (scene / "pose_50.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"pose_50\.txt: no such file"):
        ScanNet(tmp_path).num_frames("scene0707_00/color_50")


def test_scenes_whose_intrinsics_are_not_finite_are_left_out(root: Path):
    lose(root / "scans_train/scene0000_00/intrinsic/intrinsic_depth.txt")
    assert ScanNet(root).sequences == ("scene0707_00",)


def test_folders_decide_the_split_where_there_are_no_lists(root: Path):
    assert ScanNet(root, "train").sequences == ("scene0000_00",)
    assert ScanNet(root, "test").sequences == ("scene0707_00",)
    with pytest.raises(FileNotFoundError, match=r"scannetv2_val\.txt: no such file"):
        ScanNet(root, "val")


def test_official_lists_decide_where_there_is_one(root: Path):
    write_scene(root / "scans_train/scene0011_00")
    (root / "scannetv2_val.txt").write_text("scene0011_00\n")
    assert ScanNet(root, "val").sequences == ("scene0011_00",)
    assert ScanNet(root).sequences == ("scene0000_00", "scene0011_00", "scene0707_00")
    with pytest.raises(FileNotFoundError, match=r"scannetv2_train\.txt: no such file"):
        ScanNet(root, "train")
    (root / "scannetv2_train.txt").write_text("scene0000_00\nscene0001_00\n")
    with pytest.raises(FileNotFoundError, match=r"no folder of scene scene0001_00.*scannetv2_train\.txt"):
        ScanNet(root, "train")
    (root / "scannetv2_train.txt").write_text("scene0000_00\n")
    assert ScanNet(root, "train").sequences == ("scene0000_00",)
