"""Which cameras are said to be turned against a result's, and which are only predicted badly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from logvggt_jax.reconstruction.fusion.turned import turn_between

UPSIDE_DOWN, OPENGL = np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, -1.0, -1.0])


def cameras(rotations: Rotation) -> np.ndarray:
    """[N, 3, 4] world-to-camera, on a curve."""
    along = np.linspace(0, 3, len(rotations))
    centres = np.stack([np.cos(along), 0.3 * along, np.sin(along)], axis=-1)
    matrices = rotations.as_matrix()
    return np.concatenate([matrices, -matrices @ centres[..., None]], axis=2)


def tilted(count: int) -> Rotation:
    angles = np.stack([np.linspace(0, 70, count), 15 * np.sin(np.arange(count)), 5 * np.cos(np.arange(count))], axis=-1)
    return Rotation.from_euler("yxz", angles, degrees=True)


def panned(count: int) -> Rotation:
    return Rotation.from_euler("y", np.linspace(0, 70, count)[:, None], degrees=True)


def test_cameras_that_tilt_and_pan_tell_how_they_are_turned() -> None:
    own = cameras(tilted(12))
    found = turn_between(own, UPSIDE_DOWN @ own)
    assert found is not None and found.ways == [(False, 180)]
    assert found.before > 20 and found.after == pytest.approx(0, abs=1e-6)
    assert turn_between(own[:3], UPSIDE_DOWN @ own[:3]) is None, "of three cameras nobody can say"


@pytest.mark.parametrize("turn", [UPSIDE_DOWN, OPENGL])
def test_of_cameras_that_only_pan_all_ways_that_fit_are_named(turn: np.ndarray) -> None:
    own = cameras(panned(12))
    found = turn_between(own, turn @ own)
    assert found is not None and {(False, 180), (True, 0)} <= {*found.ways}


@pytest.mark.parametrize("path", [tilted, panned])
@pytest.mark.parametrize("noise", [0.0, 3.0, 20.0])
def test_predictions_that_are_bad_or_know_no_rotation_are_not_turned(path, noise: float) -> None:  # type: ignore[no-untyped-def]
    own = path(16)
    generator = np.random.default_rng(0)
    for _ in range(10):
        wrong = Rotation.from_rotvec(np.radians(noise) * generator.standard_normal((16, 3)))
        assert turn_between(cameras(wrong * own), cameras(own)) is None
        assert turn_between(cameras(wrong), cameras(own)) is None, "as if the camera had never turned"
