"""Opening a run's data: what must not be trained on, what may be absent."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from absl import logging
from PIL import Image

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.errors import EmptySplit
from logvggt_jax.data.feeding.holdouts import HoldOut
from logvggt_jax.errors import InputError
from logvggt_jax.training.config import DataConfig, SourceConfig, TrainConfig
from logvggt_jax.training.feeding import batches as module
from logvggt_jax.training.feeding.batches import stage_batches, with_all_broken
from logvggt_jax.training.feeding.sources import open_source, open_sources

OPTIONS = {"height": 28, "width": 42, "num_frames": 8, "num_rooms": 8}


def rooms(split: str) -> SourceConfig:
    return SourceConfig(name="rooms", root=None, split=split, options=tuple(OPTIONS.items()))


def data(**changes: object) -> DataConfig:
    fields = {"sources": (rooms("train"),), "reverse": 0.5, "worker_count": 0, "num_threads": 0, "cache_dir": None}
    return DataConfig(**{**fields, **changes})


def test_held_out_sequences_are_not_opened_for_training() -> None:
    held_out = (("rooms", HoldOut(names=("room-00003", "room-9*"))),)
    with pytest.raises(ValueError, match=r"rooms: 1 of 8 training sequences are held out .*\(room-00003\)"):
        open_sources(data(hold_out=held_out))
    assert "rooms" in open_sources(data(hold_out=(("rooms", HoldOut(names=("room-9*",), split="val")),)))
    # Each number is in one split only; `all` contains them.
    everything = dataclasses.replace(rooms("all"), options=(("height", 28), ("width", 42), ("num_frames", 4)))
    with pytest.raises(ValueError, match=r"room-00008.* more\): train on another split"):
        open_sources(data(sources=(everything,), hold_out=(("rooms", HoldOut(split="val")),)))


def test_a_copy_without_the_sequences_of_a_held_out_split_can_be_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def open_partial(source: SourceConfig) -> Dataset:
        if source.split == "val":
            raise EmptySplit("the lists name no sequence here for split 'val'")
        return open_source(source)

    monkeypatch.setattr("logvggt_jax.training.feeding.sources.open_source", open_partial)
    assert "rooms" in open_sources(data(hold_out=(("rooms", HoldOut(split="val")),)))


def test_validation_sequences_are_not_trained_on() -> None:
    open_sources(data(), (rooms("val"),))
    with pytest.raises(ValueError, match="rooms: 8 sequences are trained on and validated on"):
        open_sources(data(), (rooms("train"),))


def test_other_frames_of_a_sequence_may_be_validated_on() -> None:
    first, last = (dataclasses.replace(rooms("train"), frames=frames) for frames in ((None, 5), (-3, None)))
    dataset = open_sources(data(sources=(first,)), (last,))["rooms"]
    assert {dataset.num_frames(name) for name in dataset.sequences} == {5}
    more = dataclasses.replace(first, frames=(None, 6))
    with pytest.raises(InputError, match="rooms: 8 sequences are trained on and validated on"):
        open_sources(data(sources=(more,)), (last,))


def test_recordings_of_one_name_in_other_folders_are_other_recordings(tmp_path: Path) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / day / "walk").mkdir(parents=True)
        Image.fromarray(np.zeros((28, 42, 3), np.uint8)).save(tmp_path / day / "walk" / "0.png")
    (tmp_path / "link").symlink_to(tmp_path / "monday")
    monday, tuesday, link, walk = (
        SourceConfig("images", str(tmp_path / folder), "all") for folder in ("monday", "tuesday", "link", "monday/walk")
    )
    assert list(open_sources(data(sources=(monday,)), (tuesday,))["images"].sequences) == ["walk"]
    for same in (link, walk):
        with pytest.raises(InputError, match=r"images: 1 sequences are trained on and validated on \(walk\)"):
            open_sources(data(sources=(monday,)), (same,))


def test_a_rule_for_a_data_set_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="hold_out names unknown data sets: scan_net; known are co3dv2"):
        open_sources(data(hold_out=(("scan_net", HoldOut(split="test")),)))


def test_missing_data_sets_are_an_error_unless_allowed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, run_config: TrainConfig
) -> None:
    absent = SourceConfig(name="seven_scenes", root=str(tmp_path / "none"), split="train", weight=3.0)
    sources = (rooms("train"), absent)
    with pytest.raises(InputError, match=r"seven_scenes \(.*none\); .*data\.allow_missing=True"):
        open_sources(data(sources=sources))
    config = data(sources=sources, allow_missing=True)
    logging.use_python_logging(quiet=True)
    datasets = open_sources(config)
    assert list(datasets) == ["rooms"]
    assert "seven_scenes" in caplog.text and "rooms 100.0%" in caplog.text
    with stage_batches(datasets, config, run_config.stages[0], seed=0) as batches:
        assert next(batches)["images"].shape == (2, 2, 28, 42, 3)
    with pytest.raises(InputError, match="none of the data sets"):
        open_sources(data(sources=(absent,), allow_missing=True))


def test_a_data_set_to_validate_on_without_its_folder_is_named_with_the_flag(tmp_path: Path) -> None:
    absent = SourceConfig(name="tum_recording", root=str(tmp_path / "none"), split="all")
    with pytest.raises(InputError, match=r"without their folder: tum_recording \(.*none\); give --validation_source="):
        open_sources(data(), (rooms("val"), absent))
    # With those to train on that are missing as well.
    told = r"none of the data sets has its folder: tum_recording .*; data sets to validate on without their folder: tum"
    with pytest.raises(InputError, match=told):
        open_sources(data(sources=(absent,)), (absent,))


def test_a_damaged_data_set_is_not_a_missing_one(tmp_path: Path) -> None:
    present = SourceConfig(name="seven_scenes", root=str(tmp_path), split="all")
    with pytest.raises(FileNotFoundError, match="no sequences of 7-Scenes"):
        open_sources(data(sources=(rooms("train"), present), allow_missing=True))


def test_a_checkpoint_counts_the_broken_clips_of_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    state = {"examples": 8, "broken": {"count": 1, "clips": 4, "messages": ["gone"]}}
    assert with_all_broken(state) == state
    monkeypatch.setattr(module, "from_all", lambda own: np.stack([own, [3, 4]]))
    assert with_all_broken(state) == {"examples": 8, "broken": {"count": 4, "clips": 8, "messages": ["gone"]}}
