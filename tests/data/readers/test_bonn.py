"""Bonn RGB-D Dynamic: where sequences lie, and the prepared form with and without poses."""

from pathlib import Path

import numpy as np
import pytest
from layouts.timed import BONN_NAME as NAME
from layouts.timed import BONN_VIEWS as VIEWS
from layouts.timed import DEPTHS, PICTURES, POSES, STEP, write_pictures, write_sequence, write_trajectory
from room_views import check_views

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.readers.bonn import Bonn


def test_sequences_are_found_in_the_sets_own_folder_too(tmp_path: Path):
    write_sequence(tmp_path / "rgbd_bonn_dataset" / NAME, VIEWS)
    (tmp_path / "rgbd_bonn_dataset" / "rgbd_bonn_groundtruth").mkdir()
    assert Bonn(tmp_path).sequences == (NAME,)


def test_a_sequence_in_two_places_is_refused(tmp_path: Path):
    for part in (".", "rgbd_bonn_dataset"):
        (tmp_path / part / NAME / "rgb").mkdir(parents=True)
    with pytest.raises(ValueError, match="are the same sequence"):
        Bonn(tmp_path)


def write_prepared(folder: Path, pose_times: np.ndarray, *, depths: np.ndarray = DEPTHS) -> None:
    write_pictures(folder / "rgb_110", folder / "depth_110", VIEWS, depths=depths)
    write_trajectory(folder / "groundtruth_110.txt", VIEWS, pose_times)


def test_the_prepared_form_pairs_pictures_and_depth_by_place(tmp_path: Path):
    # Half a picture's time off: by time each depth would be as near to the next picture.
    write_prepared(tmp_path / NAME, PICTURES, depths=PICTURES + 0.025)
    bonn = Bonn(tmp_path)
    assert bonn.sequences == (f"{NAME}/rgb_110",)
    check_views(bonn.read(bonn.sequences[0], range(5)), VIEWS, picture_error=0, depth_error=0.51 * STEP)


def test_where_the_prepared_trajectory_misses_pictures_frames_count_without_poses(tmp_path: Path):
    write_prepared(tmp_path / NAME, POSES[:9])  # as a cut by line leaves it: the first pictures only
    name = f"{NAME}/rgb_110"
    for _ in range(2):  # listed, then from the index
        bonn = Bonn(tmp_path)
        assert bonn.num_frames(name) == 5 and bonn.dropped_frames(name) == {}
        frames = bonn.read(name, [0, 4])
        assert np.isnan(frames.extrinsics).all() and frames.depth.all()
        check_frames(frames, name, poses=False)
        with pytest.raises(ValueError, match="extrinsics must be finite"):
            check_frames(frames, name)


def test_missing_prepared_files_are_named(tmp_path: Path):
    write_prepared(tmp_path / NAME, PICTURES)
    (tmp_path / NAME / "groundtruth_110.txt").rename(tmp_path / NAME / "kept.txt")
    with pytest.raises(FileNotFoundError, match=r"groundtruth_110\.txt: no such file"):
        Bonn(tmp_path).num_frames(f"{NAME}/rgb_110")
    (tmp_path / NAME / "depth_110").rename(tmp_path / NAME / "depth_kept")
    with pytest.raises(FileNotFoundError, match="depth_110: no such folder"):
        Bonn(tmp_path).num_frames(f"{NAME}/rgb_110")
    with pytest.raises(FileNotFoundError, match="no sequences of Bonn"):
        (tmp_path / NAME / "rgb_110").rename(tmp_path / NAME / "pictures")
        Bonn(tmp_path)
