"""Masks in streams: a frame has its own, snapshots keep them, they hide what describes a place; and refusals."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.streaming import METHODS, StreamSession, open_predictor
from logvggt_jax.streaming.loops import LoopCloser, LoopSettings, frame_describer
from logvggt_jax.streaming.offline import PlainPrediction

IMAGES = np.random.default_rng(0).integers(0, 256, (7, 28, 42, 3), np.uint8)
MASKS = np.random.default_rng(1).random((7, 2, 3)) < 0.7
MASKS = np.repeat(np.repeat(MASKS, 14, axis=1), 14, axis=2)
MASKS[:, 5:10, 20:30] = False


@pytest.fixture(scope="module")
def open_stream(small_config: ModelConfig, small_variables: dict):
    return functools.partial(StreamSession, LogVGGT(small_config), small_variables)


def test_every_frame_of_a_stream_has_its_own_mask(open_stream) -> None:
    """Frame by frame or all at once; what lies under it changes nothing."""
    one, other = open_stream(), open_stream()
    found = [each for image, mask in zip(IMAGES, MASKS, strict=True) for each in one.push(image, mask)] + one.close()
    changed = np.where(MASKS[..., None], IMAGES, IMAGES[::-1])
    again = other.push(changed, MASKS) + other.close()
    for first, second in zip(found, again, strict=True):
        np.testing.assert_array_equal(first.confidence > 0, MASKS[first.index])
        np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(one.cameras().pose_encoding, other.cameras().pose_encoding)


@pytest.mark.parametrize("seen", [1, 5])
def test_a_snapshot_keeps_masks(open_stream, seen: int) -> None:
    straight, first, second = open_stream(), open_stream(), open_stream()
    expected = straight.push(IMAGES, MASKS) + straight.close()
    found = first.push(IMAGES[:seen], MASKS[:seen])
    results, arrays = first.snapshot()
    second.restore({name: array.copy() for name, array in arrays.items()})
    found += results + second.push(IMAGES[seen:], MASKS[seen:]) + second.close()
    assert [each.index for each in found] == list(range(7))
    for each, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(each.depth, other.depth)
    np.testing.assert_array_equal(second.cameras().pose_encoding, straight.cameras().pose_encoding)


def test_what_is_masked_describes_no_place(small_config, small_variables) -> None:
    describe = frame_describer(LogVGGT(small_config), small_variables)
    other = np.where(MASKS[..., None], IMAGES, IMAGES[::-1])
    np.testing.assert_array_equal(describe(IMAGES, MASKS), describe(other, MASKS))
    assert not np.allclose(describe(IMAGES, MASKS), describe(IMAGES, np.ones_like(MASKS)), atol=1e-3)


def test_places_keep_their_masks_for_loops() -> None:
    given: list[tuple[np.ndarray, ...]] = []

    def describe(*arrays: np.ndarray) -> np.ndarray:
        given.append(arrays)
        return np.zeros((len(arrays[0]), 2))

    def predict(*arrays: np.ndarray) -> PlainPrediction:
        raise AssertionError("nothing looks alike")

    closer, again = (LoopCloser(describe, predict, LoopSettings(spacing=2)) for _ in range(2))
    for image, mask in zip(IMAGES, MASKS, strict=True):
        closer.see(image, mask)
    again.restore(closer.arrays())
    again._loops(None)  # type: ignore[arg-type]
    np.testing.assert_array_equal(given[0][1][:4], MASKS[::2])


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if not method.takes_masks])
def test_other_methods_refuse_masks(small_config, method: str) -> None:
    predictor = open_predictor(method, LogVGGT(small_config), {"params": {}})
    with pytest.raises(InputError, match="takes no masks: take"):
        predictor.push(IMAGES[0], MASKS[0])


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if method.takes_masks])
def test_a_stream_has_masks_for_all_frames_or_for_none(small_config, small_variables, method: str) -> None:
    def opened():
        return open_predictor(method, LogVGGT(small_config), small_variables)

    for first, then in ((None, MASKS[1]), (MASKS[0], None)):
        predictor = opened()
        predictor.push(IMAGES[0], first)
        with pytest.raises(ValueError, match="masks for all frames or for none"):
            predictor.push(IMAGES[1], then)
    for wrong in (MASKS[0].astype(np.uint8), MASKS[0, :14], MASKS[:3]):
        with pytest.raises(ValueError, match=r"masks must be bool \[1, 28, 42\] or \[28, 42\]"):
            opened().push(IMAGES[0], wrong)
