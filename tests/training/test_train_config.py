"""Configurations of runs: built from mappings, refused in one line where they make no sense."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.holdouts import HoldOut
from logvggt_jax.training.config import TrainConfig


def _mapping(config: TrainConfig) -> dict[str, Any]:
    values = config.to_dict()
    values["stages"] = {stage.pop("name"): stage for stage in values["stages"]}
    values["data"]["sources"] = {source.pop("name"): source for source in values["data"]["sources"]}
    return values


def test_mapping_gives_the_same_run(run_config: TrainConfig) -> None:
    found = TrainConfig.from_dict(_mapping(run_config))
    assert found == run_config
    assert hash(found) == hash(run_config)


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


def test_stages_run_in_the_order_of_their_names(run_config: TrainConfig) -> None:
    values = _mapping(run_config)
    values["stages"] = {"b": values["stages"]["first"], "a": values["stages"]["second"]}
    assert [stage.name for stage in TrainConfig.from_dict(values).stages] == ["a", "b"]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (("learning_rat",), "unknown field config.learning_rat; TrainConfig knows model, loss"),
        (("optimizer", "lr"), "unknown field config.optimizer.lr; OptimizerConfig knows learning_rate"),
        (("stages", "first", "frames"), "unknown field config.stages.first.frames"),
        (("data", "sources", "rooms", "path"), "unknown field config.data.sources.rooms.path"),
        (("data", "hold_out", "scannet", "name"), "unknown field config.data.hold_out.scannet.name"),
        (("data", "augmentation", "noise"), "unknown field config.data.augmentation.noise; ColourAugmentation knows"),
        (("model", "widht"), "unknown field model.widht"),
    ],
)
def test_unknown_fields_are_named(run_config: TrainConfig, path: tuple[str, ...], message: str) -> None:
    values: Any = _mapping(run_config)
    values["data"] |= {"hold_out": {"scannet": {"names": ["scene07*"]}}, "augmentation": {}}
    target = values
    for name in path[:-1]:
        target = target[name]
    target[path[-1]] = 1
    with pytest.raises(ValueError, match=message) as error:
        TrainConfig.from_dict(values)
    assert "\n" not in str(error.value)


def test_missing_fields_are_named(run_config: TrainConfig) -> None:
    values = _mapping(run_config)
    del values["loss"]["gamma"]
    with pytest.raises(ValueError, match=r"missing field config\.loss\.gamma of LossConfig"):
        TrainConfig.from_dict(values)


@pytest.mark.parametrize(
    ("part", "field", "value", "message"),
    [
        ("loss", "name", "huber", "loss.name must be one of"),
        ("loss", "gamma", 0.0, "loss.gamma must lie in"),
        ("optimizer", "schedule", "step", "optimizer.schedule must be one of"),
        ("optimizer", "clip_norm", 0.0, "optimizer.clip_norm must be positive"),
    ],
)
def test_values_out_of_range_are_refused(
    run_config: TrainConfig, part: str, field: str, value: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(getattr(run_config, part), **{field: value})


def test_data_settings_are_checked(run_config: TrainConfig) -> None:
    with pytest.raises(ValueError, match=r"data set 'rooms': stride must be a pair 1 <= low <= high, got \(3, 2\)"):
        dataclasses.replace(run_config.data.sources[0], stride=(3, 2))
    with pytest.raises(ValueError, match=r"data\.max_broken must lie in \[0, 1\), got 1\.0"):
        dataclasses.replace(run_config.data, max_broken=1.0)


def test_stages_are_checked(run_config: TrainConfig) -> None:
    with pytest.raises(ValueError, match="min_stride=3 exceeds max_stride=2"):
        dataclasses.replace(run_config.stages[0], min_stride=3)
    with pytest.raises(ValueError, match="stage 'first': steps must be >= 1"):
        dataclasses.replace(run_config.stages[0], steps=0)
