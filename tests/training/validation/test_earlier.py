"""Which validations can be compared: those of the same clips with the same truth."""

import dataclasses
from typing import Any

import pytest

from logvggt_jax.training.config import SourceConfig, TeacherConfig, TrainConfig, ValidationConfig
from logvggt_jax.training.validation.earlier import validation_digest


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ({"every": 7}, True),
        ({"best": "auc_30"}, True),
        ({"clip_length": 4}, False),
        ({"sources": (SourceConfig("rooms", "elsewhere", "val"),)}, False),
        ({"teacher": True}, False),
        ({"teacher": False}, True),
    ],
)
def test_what_decides_clips_and_truth_decides_the_digest(
    changed: dict[str, Any], same: bool, run_config: TrainConfig
) -> None:
    validation = ValidationConfig(
        (SourceConfig("rooms", None, "val"),), every=1, num_clips=2, clip_length=3, stride=2, size=(28, 42)
    )
    config = dataclasses.replace(run_config, validation=validation)
    if "teacher" in changed:
        other = dataclasses.replace(
            config,
            loss=dataclasses.replace(config.loss, name="distillation"),
            data=dataclasses.replace(config.data, cache_dir="cache"),
            teacher=TeacherConfig("anything", clip_length=4, validation=changed["teacher"]),
        )
    else:
        other = dataclasses.replace(config, validation=dataclasses.replace(validation, **changed))
    assert (validation_digest(other) == validation_digest(config)) is same
