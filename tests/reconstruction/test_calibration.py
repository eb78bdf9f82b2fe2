"""Intrinsics that are known stand in the place of predicted ones."""

from __future__ import annotations

import numpy as np
import pytest

from logvggt_jax.data.feeding.transforms import ResizeTransform
from logvggt_jax.errors import InputError
from logvggt_jax.reconstruction import Calibration

TRANSFORM = ResizeTransform(original_size=(96, 128), size=(42, 56))


def predicted() -> np.ndarray:
    focal = np.array([50.0, 52.0, 90.0])
    matrices = np.tile(np.array([[1.0, 0, 28], [0, 1, 21], [0, 0, 1]]), (3, 1, 1))
    matrices[:, 0, 0], matrices[:, 1, 1] = focal, focal + 1
    return matrices


def test_known_intrinsics_are_those_of_the_originals() -> None:
    found = Calibration((120.0, 121.0, 60.0, 50.0)).apply(predicted(), TRANSFORM)
    original = TRANSFORM.intrinsics_to_original(found)
    expected = np.array([[120.0, 0, 60], [0, 121, 50], [0, 0, 1]])
    np.testing.assert_allclose(original, np.tile(expected, (3, 1, 1)), atol=1e-9)


def test_shared_intrinsics_are_the_median_and_none_stay_as_they_are() -> None:
    shared = Calibration(shared=True).apply(predicted(), TRANSFORM)
    np.testing.assert_array_equal(shared[:, 0, 0], 52)
    np.testing.assert_array_equal(shared[:, 1, 1], 53)
    np.testing.assert_array_equal(Calibration().apply(predicted(), TRANSFORM), predicted())


def test_what_no_camera_has_is_refused() -> None:
    for wrong in ((0.0, 1.0, 1.0, 1.0), (1.0, -1.0, 1.0, 1.0), (1.0, 1.0, float("nan"), 1.0)):
        with pytest.raises(InputError, match="focal lengths above 0"):
            Calibration(wrong)
    Calibration((100.0, 100.0, 64.0, 48.0)).check((96, 128))
    with pytest.raises(InputError, match="lies outside of images of 128 x 96 pixels"):
        Calibration((100.0, 100.0, 960.0, 540.0)).check((96, 128))
