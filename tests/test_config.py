"""The model's configuration: what it accepts, and one line that names the field for what it does not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from logvggt_jax import (
    AggregatorConfig,
    CameraHeadConfig,
    DPTConfig,
    EncoderConfig,
    ModelConfig,
    RefinementConfig,
    WindowConfig,
)


@pytest.mark.parametrize("size", [2, 3, 4, 7])
def test_any_stride_below_the_window_is_accepted(size: int) -> None:
    for stride in range(1, size):
        assert WindowConfig(size=size, stride=stride).stride == stride
    for stride in (0, size, size + 1):
        with pytest.raises(ValueError, match=r"WindowConfig\.stride"):
            WindowConfig(size=size, stride=stride)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: EncoderConfig(depth=0), r"EncoderConfig\.depth must be a positive integer, got 0"),
        (lambda: EncoderConfig(depth=1.5), r"EncoderConfig\.depth must be a positive integer, got 1\.5"),
        (lambda: EncoderConfig(depth=True), r"EncoderConfig\.depth must be a positive integer, got True"),
        (lambda: EncoderConfig(patch_size=16), r"EncoderConfig\.patch_size must be 14.*got 16"),
        (lambda: EncoderConfig(num_heads=15), r"EncoderConfig\.num_heads=15 must split the width 1024"),
        (lambda: AggregatorConfig(key_layers=(4, 11, 17)), r"AggregatorConfig\.key_layers must be four"),
        (lambda: AggregatorConfig(key_layers=(4, 11, 17, 24)), r"AggregatorConfig\.key_layers must be four"),
        (lambda: AggregatorConfig(key_layers=(11, 4, 17, 23)), r"AggregatorConfig\.key_layers must be four"),
        (lambda: CameraHeadConfig(initial_pose=(0.0,)), r"CameraHeadConfig\.initial_pose needs 9 numbers, got 1"),
        (lambda: DPTConfig(features=12), r"DPTConfig\.features must be a multiple of 8"),
        (lambda: DPTConfig(out_channels=(256, 512, 1024)), r"DPTConfig\.out_channels must be four"),
        (lambda: WindowConfig(cache="both"), r"WindowConfig\.cache must be 'output' or 'input', got 'both'"),
        (lambda: RefinementConfig(period=0), r"RefinementConfig\.period must be a positive integer, got 0"),
        (lambda: ModelConfig(dtype="int32"), r"ModelConfig\.dtype must be float32, .*got 'int32'"),
        (lambda: ModelConfig(dtype="bf16"), r"ModelConfig\.dtype must be float32, .*got 'bf16'"),
        (lambda: ModelConfig(attention="flash"), r"ModelConfig\.attention must be one of .*got 'flash'"),
        (lambda: ModelConfig(aggregator=AggregatorConfig(num_heads=512)), r"AggregatorConfig\.num_heads=512"),
        (lambda: ModelConfig(refinement=RefinementConfig(context=1)), r"context=1 must be at least the window stride"),
        (lambda: ModelConfig.from_dict({"encoder": None}), r"model\.encoder must be a mapping .*got None"),
        (lambda: ModelConfig.from_dict({"windows": {"sizes": 4}}), r"unknown field model\.windows\.sizes; .* size,"),
    ],
)
def test_what_does_not_fit_is_named(build: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        build()
    assert "\n" not in str(error.value)


def test_lists_become_tuples_so_that_configurations_hash() -> None:
    listed = ModelConfig(aggregator=AggregatorConfig(key_layers=[4, 11, 17, 23]))  # type: ignore[arg-type]
    assert listed == ModelConfig()
    assert hash(listed) == hash(ModelConfig())


def test_a_point_head_survives_the_round_trip() -> None:
    config = dataclasses.replace(ModelConfig(), point_head=DPTConfig(features=64))
    assert ModelConfig.from_dict(config.to_dict()) == config
    assert ModelConfig.from_dict(ModelConfig().to_dict()).point_head is None
