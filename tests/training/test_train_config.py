"""Configurations of runs: built from mappings, refused in one line where they make no sense."""

import dataclasses
import functools
import json
import operator
import re
from typing import Any

import pytest
from ml_collections import ConfigDict

from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.holdouts import HoldOut
from logvggt_jax.errors import InputError
from logvggt_jax.training.config import SourceConfig, TrainConfig, ValidationConfig


def _mapping(config: TrainConfig) -> dict[str, Any]:
    values = config.to_dict()
    values["stages"] = {stage.pop("name"): stage for stage in values["stages"]}
    values["data"]["sources"] = {source.pop("name"): source for source in values["data"]["sources"]}
    return values


def _set(values: dict[str, Any], path: str, value: Any) -> None:
    *parents, field = path.split(".")
    functools.reduce(operator.getitem, parents, values)[field] = value


def test_mapping_gives_the_same_run(run_config: TrainConfig) -> None:
    found = TrainConfig.from_dict(_mapping(run_config))
    assert found == run_config and hash(found) == hash(run_config)


def test_every_data_setting_survives_the_mapping(run_config: TrainConfig) -> None:
    options = dict.fromkeys(("shared", "jitter", "brightness", "contrast", "saturation", "hue", "grey", "blur"), 0.1)
    data = dataclasses.replace(
        run_config.data,
        sources=(dataclasses.replace(run_config.data.sources[0], stride=[1, 4]),),
        hold_out=(("co3dv2", HoldOut(split="test")), ("scannet", HoldOut(names=["scene07*"]))),
        augmentation=ColourAugmentation(**options, blur_sigma=[0.1, 1.0]),
        max_broken=0.01,
    )
    config = dataclasses.replace(run_config, data=data)
    found = TrainConfig.from_dict(_mapping(config))
    assert found == config and hash(found) == hash(config)


def test_settings_survive_the_form_that_checkpoints_store(run_config: TrainConfig) -> None:
    stored = json.loads(json.dumps(run_config.to_dict()))
    assert TrainConfig.from_dict(stored) == run_config and stored == run_config.to_dict()


def test_stages_run_in_the_order_written(run_config: TrainConfig) -> None:
    fields = _mapping(run_config)["stages"]["first"]

    def order(stages: Any) -> list[str]:
        return [stage.name for stage in TrainConfig.from_dict({**_mapping(run_config), "stages": stages}).stages]

    assert order({"warm-up": fields, "main": fields}) == ["warm-up", "main"]
    names = [f"stage_{number}" for number in (1, 2, 10, 11)]
    assert order(dict.fromkeys(names, fields)) == names
    assert order([{**fields, "name": name} for name in ("b", "a")]) == ["b", "a"]
    # ConfigDict sorts what it holds; a name's number decides where that lost the order.
    assert order(ConfigDict(dict.fromkeys(names, fields)).to_dict()) == names
    assert order(ConfigDict({"b": fields, "a": fields}, sort_keys=False).to_dict()) == ["b", "a"]


def test_muon_needs_whole_matrices(run_config: TrainConfig) -> None:
    values = _mapping(run_config)
    values["optimizer"] |= {"algorithm": "muon"}
    assert TrainConfig.from_dict(values).optimizer.algorithm == "muon"
    with pytest.raises(InputError, match=r"'muon' turns whole matrices.* take optimizer\.algorithm='adamw', or shard"):
        TrainConfig.from_dict({**values, "shard_parameters": True})


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("learning_rat", "unknown field config.learning_rat; TrainConfig knows model, loss"),
        ("optimizer.lr", "unknown field config.optimizer.lr; OptimizerConfig knows learning_rate"),
        ("stages.first.frames", "unknown field config.stages.first.frames"),
        ("data.sources.rooms.path", "unknown field config.data.sources.rooms.path"),
        ("data.hold_out.scannet.name", "unknown field config.data.hold_out.scannet.name"),
        ("data.augmentation.noise", "unknown field config.data.augmentation.noise; ColourAugmentation knows"),
        ("model.widht", "unknown field config.model.widht"),
    ],
)
def test_unknown_fields_are_named(run_config: TrainConfig, path: str, message: str) -> None:
    values: Any = _mapping(run_config)
    values["data"] |= {"hold_out": {"scannet": {"names": ["scene07*"]}}, "augmentation": {}}
    _set(values, path, 1)
    with pytest.raises(ValueError, match=message) as error:
        TrainConfig.from_dict(values)
    assert "\n" not in str(error.value)


def test_missing_fields_are_named(run_config: TrainConfig) -> None:
    values = _mapping(run_config)
    del values["loss"]["gamma"]
    with pytest.raises(ValueError, match=r"missing field config\.loss\.gamma, a number; LossConfig knows"):
        TrainConfig.from_dict(values)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("loss.name", "huber", "must be one of"),
        ("loss.gamma", 0.0, "must lie in"),
        ("loss.quantile", 0.995, r"must be in whole hundredths, such as 0\.98, got 0\.995"),
        ("optimizer.schedule", "step", "must be one of"),
        ("optimizer.clip_norm", 0.0, r"must lie in \(0, inf\), got 0\.0"),
        ("optimizer.b1", 1.5, r"must lie in \[0, 1\), got 1\.5"),
        ("optimizer.learning_rate", "1e-3", "must be a number, got '1e-3'"),
        ("seed", -1, "must be an integer of at least 0, got -1"),
        ("data.worker_count", -1, "must be an integer of at least 0, got -1"),
        ("data.max_broken", 1.0, r"must lie in \[0, 1\), got 1\.0"),
        ("stages.first.min_stride", 3, "=3 exceeds max_stride=2"),
        ("stages.first.steps", 0, "must be a positive integer, got 0"),
        ("stages.first.sizes", ((28, 42), (50, 70)), r"must be \(H, W\), multiples of 14 pixels, got \(50, 70\)"),
        ("stages.first.sizes", ((28, 42), (28, 42)), r"must be different \(height, width\), got"),
        ("stages.first.sizes", ((0, 70),), r"must be \(H, W\), multiples of 14 pixels, got \(0, 70\)"),
        ("stages.first.steps", "50", "must be a whole number, got '50'"),
        ("data.cache_dir", "", "='': the path is empty"),
        ("data.sources.rooms.root", " ", "=' ': the path is empty"),
        ("data.sources.rooms.stride", (3, 2), r"must be a pair 1 <= low <= high, got \(3, 2\)"),
    ],
)
def test_values_are_checked_under_their_names(run_config: TrainConfig, path: str, value: Any, message: str) -> None:
    values = _mapping(run_config)
    _set(values, path, value)
    with pytest.raises(InputError, match=rf"^config\.{re.escape(path)} ?{message}"):
        TrainConfig.from_dict(values)


def test_every_hundredth_is_a_quantile(run_config: TrainConfig) -> None:
    for hundredths in range(1, 101):
        dataclasses.replace(run_config.loss, quantile=hundredths / 100)


def test_folders_at_home_are_found(run_config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/one")
    assert SourceConfig("colmap", "~/data", "all").root == "/home/one/data"
    assert SourceConfig("colmap", "data/", "all").root == "data/"
    assert dataclasses.replace(run_config.data, cache_dir="~/labels").cache_dir == "/home/one/labels"


def test_the_size_of_validation_is_checked(run_config: TrainConfig) -> None:
    source = run_config.data.sources[0]
    with pytest.raises(InputError, match=r"^ValidationConfig\.size must be \(H, W\), multiples of 14 pixels, got"):
        ValidationConfig((source,), every=1, num_clips=1, clip_length=2, stride=1, size=(28, 50))


@pytest.mark.parametrize("change", [{"stride": (1, 4)}, {"weight": 2.0}])
def test_validation_takes_no_setting_that_it_would_not_heed(run_config: TrainConfig, change: dict[str, Any]) -> None:
    source = dataclasses.replace(run_config.data.sources[0], **change)
    with pytest.raises(InputError, match=r"^ValidationConfig\.sources: rooms has a stride or weight of its own"):
        ValidationConfig((source,), every=1, num_clips=1, clip_length=2, stride=1, size=(28, 42))
