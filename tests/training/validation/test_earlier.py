"""Which validations can be compared: those of the same clips with the same truth."""

import dataclasses
from typing import Any

import pytest

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.training.config import SourceConfig, TeacherConfig, TrainConfig, ValidationConfig
from logvggt_jax.training.feeding.sources import open_source
from logvggt_jax.training.teaching.taught import TaughtDataset
from logvggt_jax.training.validation.earlier import validation_digest


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ({"every": 7}, True),
        ({"best": "auc_30"}, True),
        ({"clip_length": 4}, False),
        ({"sources": (SourceConfig("rooms", "elsewhere", "val"),)}, False),
    ],
)
def test_what_decides_clips_and_truth_decides_the_digest(
    changed: dict[str, Any], same: bool, run_config: TrainConfig
) -> None:
    validation = ValidationConfig(
        (SourceConfig("rooms", None, "val"),), every=1, num_clips=2, clip_length=3, stride=2, size=(28, 42)
    )
    config = dataclasses.replace(run_config, validation=validation)
    other = dataclasses.replace(config, validation=dataclasses.replace(validation, **changed))
    assert (validation_digest(other) == validation_digest(config)) is same


def test_a_teacher_that_labels_validation_is_part_of_the_digest_and_its_folder_is_not(run_config: TrainConfig) -> None:
    source = SourceConfig("rooms", None, "val", options=run_config.data.sources[0].options)
    config = dataclasses.replace(
        run_config,
        validation=ValidationConfig((source,), every=1, num_clips=2, clip_length=3, stride=2, size=(28, 42)),
        data=dataclasses.replace(run_config.data, cache_dir="cache"),
    )
    loss = dataclasses.replace(run_config.loss, name="distillation")
    truth = open_source(source)

    def digest(weights: str, *datasets: Dataset, clip_length: int = 4) -> str:
        teacher = TeacherConfig(weights, clip_length=clip_length)
        return validation_digest(dataclasses.replace(config, loss=loss, teacher=teacher), datasets)

    labelled = TaughtDataset(truth, {}, "0123")
    assert digest("here", labelled) == digest("there", labelled)
    others = [
        digest("here", TaughtDataset(truth, {}, "4567")),
        digest("here", labelled, clip_length=5),
        # Judged by the truth.
        digest("here"),
    ]
    assert digest("here", labelled) not in others
    assert others[-1] == validation_digest(config)
