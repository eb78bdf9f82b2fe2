"""Mappings to settings and back, and the model's: one line names the field of what does not fit."""

import dataclasses
import json
import math
import types
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
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
from logvggt_jax.config import (
    check_longer_edge,
    check_size,
    from_mapping,
    require_counts,
    require_one_of,
    require_within,
    to_mapping,
)
from logvggt_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Part:
    name: str
    weight: float = 1.0

    def __post_init__(self) -> None:
        require_within(self, "(0, 2]", "weight")


@dataclasses.dataclass(frozen=True)
class Settings:
    count: int
    parts: tuple[Part, ...]
    rate: float | None = None
    shuffle: bool = False
    kind: Literal["a", "b"] = "a"
    sizes: tuple[tuple[int, int], ...] = ()
    options: tuple[tuple[str, Any], ...] = ()
    extras: Mapping[str, int] = dataclasses.field(default_factory=dict)
    part: Part | None = None
    limit: int | str = 1


WHOLE = {
    "count": 3,
    "parts": {"ten": {}, "two": {"weight": 2}},
    "rate": 1,
    "sizes": [[1, 2], (3, 4)],
    "options": {"b": [1, 2], "a": None},
    "extras": {"x": 1},
    "part": {"name": "p"},
    "limit": "none",
}


def test_a_mapping_becomes_the_dataclass_that_its_types_describe() -> None:
    found = from_mapping(Settings, WHOLE, "config")
    assert found.parts == (Part("ten"), Part("two", 2.0)), "in the order written"
    assert isinstance(found.rate, float) and isinstance(found.parts[1].weight, float)
    assert found.sizes == ((1, 2), (3, 4)) and found.options == (("b", (1, 2)), ("a", None))
    assert from_mapping(Settings, {"count": np.int64(3), "parts": [{"name": "one"}]}, "config").parts == (Part("one"),)
    assert from_mapping(Settings, {"count": 3, "parts": [Part("one")]}, "config").parts == (Part("one"),)


def test_settings_survive_json() -> None:
    found = from_mapping(Settings, WHOLE, "config")
    assert from_mapping(Settings, json.loads(json.dumps(to_mapping(found))), "config") == found
    assert to_mapping(found)["sizes"] == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": "50"}, r"config\.count must be a whole number, got '50'"),
        ({"count": True}, r"config\.count must be a whole number, got True"),
        ({"count": 1.0}, r"config\.count must be a whole number, got 1\.0"),
        ({"rate": "fast"}, r"config\.rate must be a number or None, got 'fast'"),
        ({"rate": False}, r"config\.rate must be a number or None, got False"),
        ({"shuffle": 1}, r"config\.shuffle must be True or False, got 1"),
        ({"kind": "c"}, r"config\.kind must be one of 'a', 'b', got 'c'"),
        ({"sizes": [[1, "2"]]}, r"config\.sizes\[0\]\[1\] must be a whole number, got '2'"),
        ({"sizes": [[1, 2, 3]]}, r"config\.sizes\[0\] must be a list of 2 items .*, got \[1, 2, 3\]"),
        ({"sizes": 5}, r"config\.sizes must be a list, each item a list of 2 items .*, got 5"),
        ({"sizes": {"a": 1}}, r"config\.sizes must be a whole number, got 'a'"),
        ({"extras": {"x": "1"}}, r"config\.extras\.x must be a whole number, got '1'"),
        ({"extras": 1}, r"config\.extras must be a mapping, got 1"),
        ({"part": 1}, r"config\.part must be a mapping with the fields of Part, got 1"),
        ({"parts": {"one": 1}}, r"config\.parts\.one must be a mapping with the fields of Part, got 1"),
        ({"parts": {"one": {"wieght": 1}}}, r"unknown field config\.parts\.one\.wieght; did you mean weight\? Part"),
        ({"parts": {"one": {"weight": 0}}}, r"^config\.parts\.one\.weight must lie in \(0, 2\], got 0\.0"),
        ({"limit": 1.5}, r"config\.limit must be a whole number or a string, got 1\.5"),
        ({"zzz": 1}, r"unknown field config\.zzz; Settings knows count, parts, rate"),
    ],
)
def test_a_value_that_does_not_fit_is_named_by_its_path(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        from_mapping(Settings, {**WHOLE, **changes}, "config")
    assert "\n" not in str(error.value)


def test_a_bug_in_a_validator_is_not_the_users() -> None:
    @dataclasses.dataclass(frozen=True)
    class Faulty:
        def __post_init__(self) -> None:
            int("a bug")

    with pytest.raises(ValueError, match="invalid literal") as error:
        from_mapping(Faulty, {}, "config")
    assert not isinstance(error.value, InputError)


def test_missing_fields_are_named_with_what_they_should_be() -> None:
    with pytest.raises(InputError, match=r"missing field config\.count, a whole number; Settings knows count, parts"):
        from_mapping(Settings, {"parts": ()}, "config")
    with pytest.raises(InputError, match=r"^missing field count, a whole number"):
        from_mapping(Settings, {"parts": ()}, "")


@pytest.mark.parametrize(("interval", "inside", "outside"), [("[0, 1)", (0, 0.5), (-1, 1)), ("(0, inf)", (9,), (0,))])
def test_intervals_are_those_of_mathematics(
    interval: str, inside: tuple[float, ...], outside: tuple[float, ...]
) -> None:
    optional, needed = (dataclasses.make_dataclass("Settings", [("x", kind)]) for kind in (float | None, float))
    require_within(optional(None), interval, "x")
    for value in inside:
        require_within(needed(value), interval, "x")
    for value in (*outside, math.nan, "1", True, None):
        with pytest.raises(InputError, match=r"Settings\.x must lie in"):
            require_within(needed(value), interval, "x")


def test_counts_and_choices() -> None:
    settings = dataclasses.make_dataclass("Settings", [("a", int), ("b", "int | None")])
    require_counts(settings(1, None), "a", "b")
    for value in (0, True, 1.0, "1", None):
        with pytest.raises(InputError, match=r"Settings\.a must be a positive integer"):
            require_counts(settings(value, 1), "a")
    require_one_of(types.SimpleNamespace(a="x"), ("x", "y"), "a")
    with pytest.raises(InputError, match="must be one of 'x', 'y', got 'z'"):
        require_one_of(types.SimpleNamespace(a="z"), ("x", "y"), "a")


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
        (lambda: EncoderConfig(patch_size=16), r"EncoderConfig\.patch_size must be one of 14, got 16"),
        (lambda: EncoderConfig(num_heads=15), r"EncoderConfig\.num_heads=15 must split the width 1024"),
        (lambda: AggregatorConfig(key_layers=(4, 11, 17)), r"AggregatorConfig\.key_layers must be four"),
        (lambda: AggregatorConfig(key_layers=(4, 11, 17, 24)), r"AggregatorConfig\.key_layers must be four"),
        (lambda: AggregatorConfig(key_layers=(11, 4, 17, 23)), r"AggregatorConfig\.key_layers must be four"),
        (lambda: AggregatorConfig(rope_base=0.0), r"AggregatorConfig\.rope_base must lie in \(0, inf\), got 0\.0"),
        (lambda: AggregatorConfig(token_scale=-1.0), r"AggregatorConfig\.token_scale must lie in \[0, inf\), got -1"),
        (lambda: CameraHeadConfig(layer_scale=math.inf), r"CameraHeadConfig\.layer_scale must lie in \[0, inf\)"),
        (lambda: CameraHeadConfig(initial_pose=(0.0,)), r"CameraHeadConfig\.initial_pose needs 9 numbers, got 1"),
        (lambda: DPTConfig(features=12), r"DPTConfig\.features must be a multiple of 8"),
        (lambda: DPTConfig(out_channels=(256, 512, 1024)), r"DPTConfig\.out_channels must be four"),
        (lambda: WindowConfig(cache="both"), r"WindowConfig\.cache must be one of 'output', 'input', got 'both'"),
        (lambda: RefinementConfig(period=0), r"RefinementConfig\.period must be a positive integer, got 0"),
        (lambda: ModelConfig(dtype="int32"), r"ModelConfig\.dtype must be one of 'float32', .*got 'int32'"),
        (lambda: ModelConfig(dtype="bf16"), r"ModelConfig\.dtype must be one of 'float32', .*got 'bf16'"),
        (lambda: ModelConfig(attention="flash"), r"ModelConfig\.attention must be one of .*got 'flash'"),
        (lambda: ModelConfig(aggregator=AggregatorConfig(num_heads=512)), r"AggregatorConfig\.num_heads=512"),
        (lambda: ModelConfig(refinement=RefinementConfig(context=1)), r"context=1 must be at least the window stride"),
        (lambda: ModelConfig.from_dict({"encoder": None}), r"model\.encoder must be a mapping .*got None"),
        (
            lambda: ModelConfig.from_dict({"windows": {"sizes": 4}}),
            r"unknown field model\.windows\.sizes; did you mean size\? WindowConfig knows size,",
        ),
    ],
)
def test_what_does_not_fit_is_named(build: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        build()
    assert "\n" not in str(error.value)


def test_lists_become_tuples_so_that_configurations_hash() -> None:
    listed = ModelConfig(aggregator=AggregatorConfig(key_layers=[4, 11, 17, 23]))  # type: ignore[arg-type]
    assert listed == ModelConfig() and hash(listed) == hash(ModelConfig())


def test_numpys_values_become_pythons() -> None:
    found = ModelConfig(
        encoder=EncoderConfig(embed_dim=np.int64(1024)),  # type: ignore[arg-type]
        aggregator=AggregatorConfig(key_layers=np.array([4, 11, 17, 23])),  # type: ignore[arg-type]
        windows=WindowConfig(size=np.int32(4)),  # type: ignore[arg-type]
        refinement=RefinementConfig(period=np.int64(2)),  # type: ignore[arg-type]
    )
    assert found == dataclasses.replace(ModelConfig(), refinement=RefinementConfig(period=2))
    assert hash(found) is not None and json.loads(json.dumps(found.to_dict())) == found.to_dict()


def test_a_point_head_survives_the_round_trip() -> None:
    config = dataclasses.replace(ModelConfig(), point_head=DPTConfig(features=64))
    assert ModelConfig.from_dict(config.to_dict()) == config
    assert ModelConfig.from_dict(ModelConfig().to_dict()).point_head is None


def test_sizes_and_edges_of_images_are_whole_patches() -> None:
    check_size((14, 518), "size")
    for size in ((14, 500), (0, 14), (-14, 14), (14.0, 14), (14,), (14, 14, 14)):
        with pytest.raises(InputError, match=r"^Some\.size must be \(H, W\), multiples of 14 pixels, got \(") as error:
            check_size(size, "Some.size")
        assert "\n" not in str(error.value)
    check_longer_edge(14)
    for edge, least in ((500, 14), (0, 14), (14, 28), (28.0, 14)):
        with pytest.raises(InputError, match=rf"^longer_edge must be a multiple of 14 pixels, at least {least}, got"):
            check_longer_edge(edge, least=least)
