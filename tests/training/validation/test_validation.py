"""Validation fetches what it judges, and judges once what knows nothing."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from logvggt_jax.errors import InputError
from logvggt_jax.training.config import SourceConfig, ValidationConfig
from logvggt_jax.training.feeding.sources import open_source
from logvggt_jax.training.parallel.sharding import data_mesh, parameter_layout
from logvggt_jax.training.validation import validation as module
from logvggt_jax.training.validation.validation import Validation
from logvggt_jax.types import Frames

ROOMS = (("height", 28), ("num_frames", 8), ("num_rooms", 2), ("width", 42))


def test_baselines_are_judged_once_and_depth_and_cameras_alone_are_fetched(
    pixel_model: Any, pixel_params: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    for name in ("depth_metrics", "relative_pose_errors"):
        original = getattr(module, name)

        def counted(*given: Any, name: str = name, original: Any = original, **options: Any) -> Any:
            calls.append(name)
            return original(*given, **options)

        monkeypatch.setattr(module, name, counted)
    source = SourceConfig("rooms", None, "val", options=ROOMS)
    config = ValidationConfig((source,), every=1, num_clips=2, clip_length=3, stride=2, size=(28, 42))
    validation = Validation(pixel_model, config, parameter_layout(pixel_params, data_mesh(2), shard=False))
    assert len(calls) == 2 * 2
    first, second = validation(pixel_params).values, validation(pixel_params).values
    assert len(calls) == 3 * 2 * 2 and first == second
    assert first["validation/constant_abs_rel"] > 0 and first["validation/identity_rotation"] > 0
    depth, extrinsics, confidence = jax.eval_shape(validation._predict, pixel_params, validation._images)
    assert depth.shape == (2, 3, 28, 42) and extrinsics.shape == (2, 3, 3, 4)
    assert confidence.shape == (1, 3, 28, 42), "of the clip that is shown"


def test_a_clip_without_depth_counts_for_nothing_in_errors_of_depth(
    pixel_model: Any, pixel_params: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = ValidationConfig(
        (SourceConfig("rooms", None, "val", options=ROOMS),),
        every=1,
        num_clips=2,
        clip_length=3,
        stride=2,
        size=(28, 42),
    )
    layout, fit = parameter_layout(pixel_params, data_mesh(1), shard=False), module.fit

    def judged(*without: int) -> np.ndarray:
        """By the model, with these of the two clips stripped of their depth."""
        numbers = itertools.count()

        def stripped(frames: Frames, size: tuple[int, int]) -> Frames:
            clip = fit(frames, size)
            return clip._replace(depth=0 * clip.depth) if next(numbers) in without else clip

        monkeypatch.setattr(module, "fit", stripped)
        values = Validation(pixel_model, config, layout)(pixel_params).values
        return np.array([values[f"validation/{name}"] for name in ("abs_rel", "delta_1.25", "constant_abs_rel")])

    np.testing.assert_allclose((judged(0) + judged(1)) / 2, judged(), rtol=1e-5)
    assert np.isnan(judged(0, 1)).all()


def test_any_number_of_clips_is_judged_on_any_number_of_devices(pixel_model: Any, pixel_params: dict[str, Any]) -> None:
    config = ValidationConfig(
        (SourceConfig("rooms", None, "val", options=(*ROOMS[:2], ("num_rooms", 5), ROOMS[3])),),
        every=1,
        num_clips=5,
        clip_length=3,
        stride=2,
        size=(28, 42),
    )

    def judged(devices: int) -> dict[str, float]:
        layout = parameter_layout(pixel_params, data_mesh(devices), shard=False)
        return Validation(pixel_model, config, layout)(pixel_params).values

    one = judged(1)
    for devices in (2, 8):
        assert judged(devices) == pytest.approx(one, rel=1e-5)


def test_what_a_device_needs_does_not_grow_with_the_clips(layered: Any, layered_params: dict[str, Any]) -> None:
    options = (*ROOMS[:2], ("num_rooms", 8), ROOMS[3])
    config = ValidationConfig(
        (SourceConfig("rooms", None, "val", options=options),),
        every=1,
        num_clips=1,
        clip_length=3,
        stride=2,
        size=(28, 42),
    )
    layout = parameter_layout(layered_params, data_mesh(1), shard=False)

    def temporaries(clips: int) -> int:
        validation = Validation(layered, dataclasses.replace(config, num_clips=clips), layout)
        program = validation._predict.lower(layered_params, validation._images).compile()
        return int(program.memory_analysis().temp_size_in_bytes)

    # Of each further clip its depth and confidence alone, not the sixteen numbers that layers have of every pixel.
    assert temporaries(8) - temporaries(2) < 4 * 6 * (4 * 3 * 28 * 42)


def test_parameters_in_parts_judge_as_whole_ones(layered: Any, layered_params: dict[str, Any]) -> None:
    source = SourceConfig("rooms", None, "val", options=ROOMS)
    config = ValidationConfig((source,), every=1, num_clips=4, clip_length=3, stride=2, size=(28, 42))

    def judged(shard: bool) -> dict[str, float]:
        layout = parameter_layout(layered_params, data_mesh(2), shard=shard)
        return Validation(layered, config, layout)(layout.put(layered_params)).values

    assert judged(True) == pytest.approx(judged(False), rel=1e-5)


def test_each_source_has_its_clips_its_means_and_its_pictures(pixel_model: Any, pixel_params: dict[str, Any]) -> None:
    others = (*ROOMS[:3], ("seed", 5), ROOMS[3])
    sources = (
        SourceConfig("rooms", None, "val", options=ROOMS),
        SourceConfig("more", None, "val", options=others),
    )
    with pytest.MonkeyPatch.context() as patch:
        opened = module.open_source
        patch.setattr(module, "open_source", lambda source: opened(dataclasses.replace(source, name="rooms")))
        both = _judged(pixel_model, pixel_params, sources)
        alone = [_judged(pixel_model, pixel_params, (source,)).values for source in sources]
    for name, value in alone[0].items():
        plain = name.removeprefix("validation/")
        assert both.values[f"validation/rooms/{plain}"] == pytest.approx(value, rel=1e-5)
        assert both.values[f"validation/more/{plain}"] == pytest.approx(alone[1][name], rel=1e-5)
        if plain != "rotation_over_identity":
            assert both.values[name] == pytest.approx((value + alone[1][name]) / 2, rel=1e-5)
    assert alone[0]["validation/constant_abs_rel"] != alone[1]["validation/constant_abs_rel"]
    assert set(both.pictures) == {
        f"validation/{name}/{kind}" for name in ("rooms", "more") for kind in ("clip", "trajectory")
    }


def _judged(model: Any, params: Any, sources: tuple[SourceConfig, ...]) -> module.Judgement:
    config = ValidationConfig(sources, every=1, num_clips=2, clip_length=3, stride=2, size=(28, 42))
    return Validation(model, config, parameter_layout(params, data_mesh(1), shard=False))(params)


def test_one_sequence_gives_clips_from_several_places() -> None:
    source = SourceConfig("rooms", None, "val", options=(*ROOMS[:2], ("num_rooms", 2), ROOMS[3]))
    config = ValidationConfig((source,), every=1, num_clips=5, clip_length=3, stride=2, size=(28, 42))
    rooms = open_source(source)
    first, second = rooms.sequences
    expected = [(first, 0), (first, 2), (first, 3), (second, 0), (second, 3)]
    clips = module._read_clips("rooms", rooms, config)
    assert len(clips) == len(expected)
    for clip, (name, start) in zip(clips, expected, strict=True):
        np.testing.assert_array_equal(clip.extrinsics, rooms.read(name, range(start, start + 5, 2)).extrinsics)
    with pytest.raises(InputError, match="has 2 sequences of at least 5 frames, num_clips=9 needs more or longer"):
        module._read_clips("rooms", rooms, dataclasses.replace(config, num_clips=9))


def test_a_short_sequence_gives_what_it_has_room_for_and_long_ones_the_rest() -> None:
    frames = {"short": 6, "too short": 4, "long": 30}
    recordings: Any = SimpleNamespace(sequences=list(frames), num_frames=frames.get)
    source = SourceConfig("tum_recording", "mine", "all")
    config = ValidationConfig((source,), every=1, num_clips=8, clip_length=3, stride=2, size=(28, 42))
    found = module.clip_starts("tum_recording", recordings, config)
    assert found == [("short", 0), ("short", 1), *(("long", start) for start in (0, 5, 10, 15, 20, 25))]
