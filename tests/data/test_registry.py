"""Data sets by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from logvggt_jax.data import DATASETS, open_dataset
from logvggt_jax.data.registry import READERS


def test_every_name_has_a_reader_of_that_name():
    # The order and spelling of the project's public list.
    expected = "co3dv2 blendedmvs arkitscenes wildrgbd scannet mvs_synth pointodyssey virtual_kitti spring hypersim"
    assert " ".join(DATASETS) == f"{expected} replica seven_scenes nrgbd sintel bonn kitti tum rooms"
    for name, reader in READERS.items():
        assert reader.name == name
        assert "all" in reader.splits
        assert reader.title and reader.expects


@pytest.mark.parametrize("name", READERS)
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


def test_wrong_names_splits_and_roots_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"'kity'.*choose one of co3dv2.*rooms"):
        open_dataset("kity", tmp_path)
    with pytest.raises(ValueError, match="'trian'"):
        open_dataset("rooms", None, split="trian")
    with pytest.raises(ValueError, match="root=None"):
        open_dataset("rooms", tmp_path)
    with pytest.raises(ValueError, match="needs root"):
        open_dataset("seven_scenes", None)
