"""Bonn RGB-D Dynamic: a written sequence of known geometry comes back, and the prepared form with and without poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from room_sequence import assert_shows_room
from timed_sequence import DEPTHS, PICTURES, POSES, STEP, write_pictures, write_sequence, write_trajectory

from logvggt_jax.data.dataset import check_frames
from logvggt_jax.data.readers.bonn import Bonn

NAME = "rgbd_bonn_balloon2"
INTRINSICS = np.array([[54.2822841, 0, 31.109352], [0, 54.257687, 23.3256098], [0, 0, 1]])
ORDER = [3, 0, 1, 2]


@pytest.mark.parametrize("part", [".", "rgbd_bonn_dataset"])
def test_a_written_sequence_comes_back(tmp_path: Path, part: str):
    write_sequence(tmp_path / part / NAME, INTRINSICS)
    (tmp_path / part / "rgbd_bonn_groundtruth").mkdir()
    bonn = Bonn(tmp_path)
    assert bonn.sequences == (NAME,) and bonn.metric
    assert bonn.frame_names(NAME) == [f"{time:.6f}" for time in PICTURES]
    assert_shows_room(bonn.read(NAME, ORDER), ORDER, INTRINSICS, depth_step=STEP)


def test_a_sequence_in_two_places_is_refused(tmp_path: Path):
    for part in (".", "rgbd_bonn_dataset"):
        (tmp_path / part / NAME / "rgb").mkdir(parents=True)
    with pytest.raises(ValueError, match="are the same sequence"):
        Bonn(tmp_path)


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_there_are_no_splits(tmp_path: Path, split: str):
    with pytest.raises(ValueError, match=f"Bonn RGB-D Dynamic has no split '{split}'"):
        Bonn(tmp_path, split)


def write_prepared(folder: Path, pose_times: np.ndarray, *, depths: np.ndarray = DEPTHS) -> None:
    write_pictures(folder / "rgb_110", folder / "depth_110", INTRINSICS, depths=depths)
    write_trajectory(folder / "groundtruth_110.txt", pose_times)


def test_the_prepared_form_pairs_pictures_and_depth_by_place(tmp_path: Path):
    # Half a picture's time off: by time each depth would be as near to the next picture.
    write_prepared(tmp_path / NAME, PICTURES, depths=PICTURES + 0.025)
    bonn = Bonn(tmp_path)
    assert bonn.sequences == (f"{NAME}/rgb_110",)
    assert_shows_room(bonn.read(bonn.sequences[0], ORDER), ORDER, INTRINSICS, depth_step=STEP)


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
