"""Data sets by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from logvggt_jax.data import DATASETS, open_dataset
from logvggt_jax.data.registry import _READERS


def test_all_names_are_listed_once_and_readers_are_among_them():
    assert len(DATASETS) == len(set(DATASETS)) == 18
    assert set(_READERS) <= set(DATASETS)


def test_rooms_open_without_a_folder():
    rooms = open_dataset("rooms", None, split="val")
    frames = rooms.read(rooms.sequences[0], [0])
    assert frames.images.shape == (1, 96, 128, 3)
    assert rooms.sequences[0] not in open_dataset("rooms", None, split="train").sequences


def test_names_without_a_reader_say_which_have_one():
    for name in set(DATASETS) - set(_READERS):
        with pytest.raises(ValueError, match=f"no reader for '{name}'.*rooms.*seven_scenes"):
            open_dataset(name, "data")


def test_wrong_names_splits_and_roots_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"'kity'.*choose one of co3dv2.*rooms"):
        open_dataset("kity", tmp_path)
    with pytest.raises(ValueError, match="'trian'"):
        open_dataset("rooms", None, split="trian")
    with pytest.raises(ValueError, match="root=None"):
        open_dataset("rooms", tmp_path)
    with pytest.raises(ValueError, match="needs root"):
        open_dataset("seven_scenes", None)
