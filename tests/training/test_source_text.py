"""Data sources on the command line."""

from typing import Any

import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import SourceConfig, TrainConfig
from logvggt_jax.training.source_text import parse_source, with_sources


def test_a_source_has_a_name_a_folder_and_what_is_said_of_it() -> None:
    found = parse_source("colmap=/data/a=b,c/walk,frames=-200:,stride=1:4,weight=2.5,split=train")
    assert found == {
        "name": "colmap",
        "root": "/data/a=b,c/walk",
        "split": "train",
        "frames": (-200, None),
        "stride": (1, 4),
        "weight": 2.5,
    }
    assert parse_source("rooms=") == {"name": "rooms", "root": None, "split": "all"}


@pytest.mark.parametrize("text", ["seven_scenes", "=/data", "colmap=/a,frames=3", "colmap=/a,weight=much"])
def test_another_form_is_refused_with_the_right_one(text: str) -> None:
    with pytest.raises(InputError, match=r"a source is NAME=FOLDER, then any of ,split="):
        parse_source(text)


def test_sources_take_the_place_of_the_configurations(run_config: TrainConfig) -> None:
    settings: dict[str, Any] = run_config.to_dict()
    settings["validation"] = {
        "sources": [{"name": "rooms", "root": None, "split": "val"}],
        "every": 1,
        "num_clips": 1,
        "clip_length": 2,
        "stride": 1,
        "size": (28, 42),
    }
    changed = TrainConfig.from_dict(
        with_sources(settings, ["tum_recording=/a,frames=:700", "colmap=/b"], ["tum=/c", "colmap=/d"])
    )
    assert changed.data.sources == (
        SourceConfig("tum_recording", "/a", "all", frames=(None, 700)),
        SourceConfig("colmap", "/b", "all"),
    )
    assert changed.validation is not None and changed.validation.sources == (
        SourceConfig("tum", "/c", "all"),
        SourceConfig("colmap", "/d", "all"),
    )
    assert with_sources(settings, [], []) == settings
    assert TrainConfig.from_dict(with_sources(settings, ["colmap=/b"], ["none"])).validation is None
    with pytest.raises(InputError, match="is none and something"):
        with_sources(settings, [], ["none", "colmap=/b"])
    with pytest.raises(InputError, match=r"config\.data\.sources: colmap is named twice"):
        TrainConfig.from_dict(with_sources(settings, ["colmap=/a", "colmap=/b"], []))
    with pytest.raises(InputError, match="validates nothing"):
        with_sources(run_config.to_dict(), [], ["colmap=/a"])
