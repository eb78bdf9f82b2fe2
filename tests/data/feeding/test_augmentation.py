"""Colour augmentation: what each part does to colours, and who shares a draw."""

from typing import Any

import numpy as np
import pytest

from logvggt_jax.data.feeding.augmentation import ColourAugmentation

OFF = {"shared": 1.0, "jitter": 0.0, "brightness": 0.0, "contrast": 0.0, "saturation": 0.0, "hue": 0.0, "grey": 0.0}
OFF |= {"blur": 0.0, "blur_sigma": (0.5, 1.0)}
LUMA = np.array([0.299, 0.587, 0.114])


def pictures(count: int = 4) -> np.ndarray:
    """One random picture of middle colours, repeated: nothing is clipped, and frames can be compared."""
    return np.tile(np.random.default_rng(0).integers(90, 160, (1, 12, 16, 3), np.uint8), (count, 1, 1, 1))


def changed(images: np.ndarray, seed: int = 0, **options: Any) -> np.ndarray:
    result = images.copy()
    ColourAugmentation(**{**OFF, **options})(result, np.random.default_rng(seed))
    return result


def test_nothing_changes_where_nothing_is_drawn():
    images = pictures()
    assert np.array_equal(changed(images), images)
    assert np.array_equal(changed(images, jitter=1.0), images)


def test_a_draw_serves_the_clip_or_each_frame_has_its_own():
    options = {"jitter": 1.0, "brightness": 0.3, "hue": 0.2, "blur": 0.5}
    together, apart = changed(pictures(), shared=1.0, **options), changed(pictures(), shared=0.0, **options)
    assert all(np.array_equal(frame, together[0]) for frame in together)
    assert not any(np.array_equal(frame, apart[0]) for frame in apart[1:])
    assert np.array_equal(apart, changed(pictures(), shared=0.0, **options)), "the generator decides everything"


@pytest.mark.parametrize("seed", range(5))
def test_brightness_multiplies_contrast_stretches_about_the_mean(seed: int):
    images = pictures(1).astype(np.float64)
    brighter = changed(pictures(1), seed, jitter=1.0, brightness=0.3).astype(np.float64)
    factor = (brighter * images).sum() / (images**2).sum()
    assert 0.7 <= factor <= 1.3 and abs(factor - 1) > 1e-3
    np.testing.assert_allclose(brighter, factor * images, atol=0.6)

    stretched = changed(pictures(1), seed, jitter=1.0, contrast=0.3).astype(np.float64)
    assert (stretched @ LUMA).mean() == pytest.approx((images @ LUMA).mean(), abs=0.3)
    ratio = stretched.std() / images.std()
    assert 0.68 <= ratio <= 1.32 and abs(ratio - 1) > 1e-2


@pytest.mark.parametrize("seed", range(5))
def test_saturation_and_hue_leave_grey_alone(seed: int):
    grey = np.repeat(pictures(1)[..., :1], 3, axis=3)
    options = {"jitter": 1.0, "saturation": 0.9, "hue": 0.5}
    assert np.abs(changed(grey, seed, **options).astype(int) - grey).max() <= 1
    images = pictures(1).astype(np.float64)
    turned = changed(pictures(1), seed, jitter=1.0, hue=0.5).astype(np.float64)
    spread = [np.linalg.norm(each - each.mean(3, keepdims=True), axis=3) for each in (images, turned)]
    np.testing.assert_allclose(spread[1], spread[0], atol=1.0)
    assert np.abs(turned - images).max() > 5


def test_grey_pictures_show_the_luma():
    images = pictures(1)
    result = changed(images, grey=1.0)
    np.testing.assert_allclose(result, np.repeat((images @ LUMA)[..., None], 3, axis=3), atol=0.6)


def test_blur_averages_neighbours():
    edge = np.zeros((1, 8, 20, 3), np.uint8)
    edge[:, :, 10:] = 200
    result = changed(edge, blur=1.0, blur_sigma=(1.0, 1.0))[0, 4, :, 0].astype(int)
    assert (np.diff(result) >= 0).all() and 0 < result[9] < 100 < result[10] < 200
    assert result[0] == 0 and result[-1] == 200


def test_probabilities_are_kept():
    grey = [np.ptp(changed(pictures(1), seed, grey=0.3), axis=3).max() == 0 for seed in range(1000)]
    assert np.mean(grey) == pytest.approx(0.3, abs=0.05)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [({"hue": 0.6}, r"hue must lie in \[0, 0.5\]"), ({"shared": 1.1}, "shared"), ({"blur_sigma": (2.0, 1.0)}, "sigma")],
)
def test_strengths_out_of_range_are_refused(options: dict, complaint: str):
    with pytest.raises(ValueError, match=f"augmentation.*{complaint}"):
        changed(pictures(), **options)
