"""Data sets by name."""

import json
from pathlib import Path

import numpy as np
import pytest

from logvggt_jax.data import DATASETS, open_dataset
from logvggt_jax.data.registry import READERS
from logvggt_jax.errors import InputError


def test_every_name_has_a_reader_of_that_name():
    # The order and spelling of the project's public list.
    expected = "co3dv2 blendedmvs arkitscenes wildrgbd scannet mvs_synth pointodyssey virtual_kitti spring hypersim"
    assert " ".join(DATASETS[:18]) == f"{expected} replica seven_scenes nrgbd sintel bonn kitti tum rooms"
    for name, reader in READERS.items():
        assert reader.name == name and "all" in reader.splits and reader.title and reader.expects


@pytest.mark.parametrize("name", [name for name, reader in READERS.items() if reader.needs_root])
def test_an_empty_or_missing_folder_is_named(name: str, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}.*nowhere"):
        open_dataset(name, tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=str(tmp_path)):
        open_dataset(name, tmp_path)
    for split in {"train", "val", "test"} - set(READERS[name].splits):
        with pytest.raises(ValueError, match=f"has no split '{split}'"):
            open_dataset(name, tmp_path, split)


def test_rooms_open_without_a_folder():
    rooms = open_dataset("rooms", None, split="val")
    frames = rooms.read(rooms.sequences[0], [0])
    assert frames.images.shape == (1, 96, 128, 3)
    assert rooms.sequences[0] not in open_dataset("rooms", None, split="train").sequences


def test_a_set_that_is_made_says_what_others_ask_of_it():
    options = {"num_frames": 3, "num_rooms": 2, "seed": 5, "speed": (0.7, 1.3), "facing_north": 0.5}
    rooms = open_dataset("rooms", None, "test", **READERS["rooms"].size_options((28, 42)), **options)
    assert rooms.image_size(rooms.sequences[0]) == (28, 42)
    training = rooms.training_split()
    assert training is not None and training.identity == rooms.identity
    assert len(training.sequences) == 1500 and set(training.sequences).isdisjoint(rooms.sequences)
    pool = rooms.for_training(cache_dir=None, progress=False)
    for dataset in (rooms, pool):
        assert dataset.sfm_extrinsics(rooms.sequences[0], [0]) is None
    np.testing.assert_array_equal(pool.read(rooms.sequences[1], [2]).images, rooms.read(rooms.sequences[1], [2]).images)


def test_wrong_names_splits_and_roots_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"'kity'.*choose one of co3dv2.*rooms"):
        open_dataset("kity", tmp_path)
    with pytest.raises(ValueError, match="'trian'"):
        open_dataset("rooms", None, split="trian")
    with pytest.raises(ValueError, match="root=None"):
        open_dataset("rooms", tmp_path)
    with pytest.raises(ValueError, match="needs root"):
        open_dataset("seven_scenes", None)


def test_options_go_to_the_reader_and_unknown_ones_are_refused(tmp_path: Path):
    rooms = open_dataset("rooms", None, "test", height=28, width=42, num_frames=3, num_rooms=1)
    assert rooms.read(rooms.sequences[0], range(3)).images.shape == (3, 28, 42, 3)
    with pytest.raises(InputError, match="rooms: unknown option 'hight'; known are height, width"):
        open_dataset("rooms", None, hight=28)
    with pytest.raises(InputError, match="replica: unknown option 'height'; known are none"):
        open_dataset("replica", tmp_path, height=28)


def test_identities_tell_apart_what_gives_other_frames():
    rooms = [
        open_dataset("rooms", None, "test", num_rooms=1, **options) for options in ({}, {"seed": 1}, {"width": 70})
    ]
    assert len({json.dumps(each.identity) for each in rooms}) == 3
    # A room is the same whichever others are opened with it.
    for split, count in (("test", 1), ("test", 2), ("all", 1)):
        assert rooms[0].identity == open_dataset("rooms", None, split, num_rooms=count).identity
