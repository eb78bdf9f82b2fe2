"""What every reader promises, on the analytic room written in each set's own files."""

import importlib
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts.layout import Layout
from room_views import check_views

from logvggt_jax.data import open_dataset
from logvggt_jax.data.errors import BadPose, MissingFiles
from logvggt_jax.data.readers.folder_dataset import FolderDataset
from logvggt_jax.data.registry import READERS
from logvggt_jax.errors import InputError

# Pictures alone promise nothing of depth and cameras; see test_images.
NAMES = [name for name, reader in READERS.items() if reader.needs_root and name != "images"]
POSED = [name for name in NAMES if name != "kitti"]


def layout_of(name: str) -> Layout:
    if name in ("tum", "bonn"):
        return next(each for each in importlib.import_module("layouts.timed").LAYOUTS if each.reader.name == name)
    return importlib.import_module(f"layouts.{name}").LAYOUT


@pytest.fixture
def layout(request: pytest.FixtureRequest) -> Layout:
    return layout_of(request.param)


every_set = pytest.mark.parametrize("layout", NAMES, indirect=True)
sets_with_poses = pytest.mark.parametrize("layout", POSED, indirect=True)


def opened(layout: Layout, root: Path) -> FolderDataset:
    dataset = open_dataset(layout.reader.name, root)
    assert isinstance(dataset, layout.reader)
    return dataset


def with_second(layout: Layout, **changes: np.ndarray) -> list:
    """The layout's views with the second one changed."""
    views = list(layout.views)
    views[1] = replace(views[1], **changes)
    return views


def named(error: pytest.ExceptionInfo, path: str) -> bool:
    """Whether the error names `path`; it is of one line for people, and survives the way out of a worker process."""
    message = str(error.value)
    assert isinstance(error.value, InputError) and "\n" not in message
    assert str(pickle.loads(pickle.dumps(error.value))) == message
    return path in message


@every_set
def test_frames_come_back_with_their_units_in_the_order_asked_for(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, layout.views)
    dataset = opened(layout, tmp_path)
    name = layout.sequence
    assert name in dataset.sequences and len(set(dataset.sequences)) == len(dataset.sequences)
    assert dataset.frame_names(name) == list(layout.names) and len(set(layout.names)) == len(layout.names)
    assert dataset.num_frames(name) == len(layout.views) and dataset.dropped_frames(name) == {}
    order = [2, 0, 1, 3, *range(4, len(layout.views))]
    frames = dataset.read(name, order)
    assert frames.metric is dataset.metric is (layout.unit == 1.0 and name not in UNSCALED)
    assert dataset.image_size(name) == frames.images.shape[1:3]
    in_metres = frames._replace(depth=frames.depth / np.float32(layout.unit), extrinsics=frames.extrinsics.copy())
    in_metres.extrinsics[:, :3, 3] /= layout.unit
    expected = [replace(layout.views[i], picture=layout.developed(layout.views[i].picture)) for i in order]
    errors = {"picture_error": layout.picture_error, "depth_error": layout.depth_error}
    check_views(in_metres, expected, **errors, poses=layout.poses != "none")
    np.testing.assert_array_equal(dataset.extrinsics(name)[order], frames.extrinsics)
    # A copy on the disk is trained on as it is; which of it was trained on is not known.
    assert dataset.for_training(cache_dir=None, progress=False) is dataset and dataset.training_split() is None
    assert dataset.size_options((28, 42)) == {} and dataset.sfm_extrinsics(name, [0]) is None


# Metres as written here, but each sequence of the set has a scale of its own.
UNSCALED = {layout_of(name).sequence for name in ("co3dv2", "blendedmvs", "colmap", "nerfstudio")}


@sets_with_poses
def test_a_frame_whose_pose_is_lost_does_not_count_and_the_others_keep_their_files(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, with_second(layout, pose=np.full((4, 4), np.nan)))
    for _ in range(2):  # listed, then from the index
        dataset = opened(layout, tmp_path)
        kept = [i for i in range(len(layout.views)) if i != 1]
        assert dataset.frame_names(layout.sequence) == [layout.names[i] for i in kept]
        assert dataset.dropped_frames(layout.sequence) == {"no pose": 1}
    frames = dataset.read(layout.sequence, range(len(kept)))
    in_metres = frames._replace(depth=frames.depth / np.float32(layout.unit), extrinsics=frames.extrinsics.copy())
    in_metres.extrinsics[:, :3, 3] /= layout.unit
    expected = [replace(layout.views[i], picture=layout.developed(layout.views[i].picture)) for i in kept]
    check_views(in_metres, expected, picture_error=layout.picture_error, depth_error=layout.depth_error, overlap=0.3)


@sets_with_poses
def test_a_sequence_without_any_pose_is_named(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, [replace(each, pose=np.full((4, 4), np.nan)) for each in layout.views])
    with pytest.raises(InputError, match=rf"counts here \(dropped: {{'no pose': {len(layout.views)}}}\)"):
        opened(layout, tmp_path).num_frames(layout.sequence)


@pytest.mark.parametrize("layout", ["mvs_synth", "pointodyssey", "virtual_kitti", "spring", "sintel"], indirect=True)
def test_a_frame_without_finite_intrinsics_does_not_count(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, with_second(layout, intrinsics=np.full((3, 3), np.inf)))
    assert opened(layout, tmp_path).dropped_frames(layout.sequence) == {"no intrinsics": 1}


@pytest.mark.parametrize("layout", [name for name in POSED if layout_of(name).poses == "matrix"], indirect=True)
def test_a_pose_that_is_no_rotation_is_named(layout: Layout, tmp_path: Path):
    pose = layout.views[1].pose @ np.diag([2.0, 2.0, 2.0, 1.0])
    layout.write(tmp_path, with_second(layout, pose=pose))
    with pytest.raises(BadPose) as error:
        opened(layout, tmp_path).num_frames(layout.sequence)
    assert named(error, str(tmp_path))


@every_set
def test_pixels_without_depth_are_zero_and_a_frame_without_any_is_kept(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, with_second(layout, depth=0 * layout.views[1].depth))
    frames = opened(layout, tmp_path).read(layout.sequence, [0, 1])
    assert frames.depth[0].any() and (frames.depth[1] == 0).all()


@every_set
def test_depth_of_another_shape_is_named(layout: Layout, tmp_path: Path):
    depth = layout.views[1].depth
    layout.write(tmp_path, with_second(layout, depth=depth[: len(depth) // 2]))
    with pytest.raises(InputError) as error:
        opened(layout, tmp_path).read(layout.sequence, [0, 1])
    assert named(error, Path(layout.depth).stem.split(".")[0])


@every_set
def test_what_is_missing_is_named(layout: Layout, tmp_path: Path):
    for index, missing in enumerate(layout.needed):
        root = tmp_path / str(index)
        layout.write(root, layout.views)
        (root / missing).rename(tmp_path / "aside")
        with pytest.raises(MissingFiles) as error:
            opened(layout, root).num_frames(layout.sequence)
        assert named(error, f"{root / missing}: no such f"), error.value
        (tmp_path / "aside").rename(tmp_path / f"aside {index}")


@every_set
def test_pictures_and_depth_that_vanish_or_break_after_listing_are_named(layout: Layout, tmp_path: Path, capfd):
    layout.write(tmp_path, layout.views)
    dataset = opened(layout, tmp_path)
    for name in (layout.image, layout.depth):
        path = tmp_path / name
        whole = path.read_bytes()
        for damaged in (whole[: len(whole) // 2], whole[:-30], b"", b"no picture"):
            path.write_bytes(damaged)
            with pytest.raises(InputError) as error:
                dataset.read(layout.sequence, [0, 1])
            assert named(error, f"{path}: ") and error.value.kind == "broken picture"
        path.unlink()
        with pytest.raises(MissingFiles) as error:
            dataset.read(layout.sequence, [0, 1])
        assert named(error, f"{path}: no such file")
        path.write_bytes(whole)
    assert len(dataset.read(layout.sequence, [0, 1]).images) == 2
    capfd.readouterr()  # the libraries' own complaints


@every_set
@pytest.mark.parametrize("content", [b"", b"no numbers", b"\xff\xfe\x00"])
def test_damaged_calibrations_and_poses_are_named(layout: Layout, tmp_path: Path, content: bytes):
    layout.write(tmp_path, layout.views)
    for name in layout.tables:
        path = tmp_path / name
        whole = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(InputError) as error:
            opened(layout, tmp_path).read(layout.sequence, [0, 1])
        assert named(error, str(path)), error.value
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("layout", "place"),
    [(name, place) for name in NAMES for place in range(len(layout_of(name).damages))],
    indirect=["layout"],
)
def test_what_is_wrong_with_a_copy_is_named(layout: Layout, tmp_path: Path, place: int):
    complaint, damage = layout.damages[place]
    layout.write(tmp_path, layout.views)
    damage(tmp_path)
    with pytest.raises(InputError, match=complaint) as error:
        opened(layout, tmp_path).read(layout.sequence, [0, 1])
    assert named(error, str(tmp_path))


@every_set
def test_sequences_and_frames_that_are_not_there_are_refused(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, layout.views)
    dataset = opened(layout, tmp_path)
    with pytest.raises(KeyError, match="no sequence 'nowhere'"):
        dataset.read("nowhere", [0])
    for indices in ([len(layout.views)], [-1], [], [0.7], [np.float32(1)], [True], ["1"], np.ones(2, bool)):
        with pytest.raises(IndexError):
            dataset.read(layout.sequence, indices)
    assert len(dataset.read(layout.sequence, np.array([1, 0], np.uint8)).images) == 2


@every_set
def test_what_file_managers_and_network_storage_leave_is_passed_over(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, layout.views)
    before = opened(layout, tmp_path)
    frames = before.frame_names(layout.sequence)
    for folder in [tmp_path, *(path for path in tmp_path.rglob("*") if path.is_dir())]:
        for path in list(folder.iterdir()):
            (folder / f"._{path.name}").write_bytes(b"\0\5\x16\7")
        for name in (".DS_Store", "Thumbs.db", "desktop.ini"):
            (folder / name).write_bytes(b"\0")
        for name in ("@eaDir", ".ipynb_checkpoints"):
            (folder / name).mkdir()
    after = opened(layout, tmp_path)
    assert after.sequences == before.sequences and after.frame_names(layout.sequence) == frames
    assert after.dropped_frames(layout.sequence) == {}


@every_set
def test_a_copy_can_be_sent_to_a_worker(layout: Layout, tmp_path: Path):
    layout.write(tmp_path, layout.views)
    dataset = opened(layout, tmp_path)
    first = dataset.read(layout.sequence, [1])
    second = pickle.loads(pickle.dumps(dataset)).read(layout.sequence, [1])
    assert all((one == other).all() for one, other in zip(first[:3], second[:3], strict=True))
