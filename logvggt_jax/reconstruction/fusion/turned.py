"""Whether poses from elsewhere have cameras that are turned against those of a result's frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from logvggt_jax.data.formats.calibration import OPENGL_AXES
from logvggt_jax.geometry import pose_similarity, rotation_angle

# Of fewer cameras nobody can say.
_FEWEST = 4
# Degrees by which cameras have to differ as they are, and how many times as much as once they are turned.
_APART, _TIMES = 2.0, 3.0


# Degrees, and a share, by which a way may fit less well than the best and still be meant.
_ALIKE, _ALIKE_SHARE = 0.1, 0.1


class Turn(NamedTuple):
    """How cameras have to be turned to fit others.

    Attributes:
      ways: each whether their axes are OpenGL's (y up, z backward), and the degrees by which their pictures have to be
        turned clockwise; cameras that turn about one axis alone do not tell all of them apart.
      before: degrees by which cameras differ as they are, the median.
      after: the same once they are turned.
    """

    ways: list[tuple[bool, int]]
    before: float
    after: float


def turn_between(extrinsics: np.ndarray, others: np.ndarray) -> Turn | None:
    """How the cameras `others` have to be turned to fit `extrinsics`; None where they do as they are, or in no way.

    Where both are of the same pictures and have the same axes, one rotation of the world carries all cameras into the
    others. If they are turned, tilts and pans are no longer the same.

    Args:
      extrinsics: [N, 3|4, 4] world-to-camera, of a result.
      others: [N, 3|4, 4] of the same frames, in another world.

    Raises:
      NoSimilarity: the cameras say nothing of the scale.
    """
    if len(extrinsics) < _FEWEST:
        return None

    def difference(opengl: bool, clockwise: int) -> float:
        cosine, sine = round(np.cos(np.radians(clockwise))), round(np.sin(np.radians(clockwise)))
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float64)
        turned = (turn @ OPENGL_AXES[:3, :3] if opengl else turn) @ others[:, :3]
        moved = pose_similarity(extrinsics, turned).apply_to_extrinsics(extrinsics)
        return float(np.degrees(np.median(rotation_angle(moved[:, :3, :3], turned[:, :3, :3]))))

    ways = [(opengl, clockwise) for opengl in (False, True) for clockwise in (0, 90, 180, 270)]
    before, *differences = (difference(*way) for way in ways)
    after = min(differences)
    alike = [
        way for way, each in zip(ways[1:], differences, strict=True) if each <= after * (1 + _ALIKE_SHARE) + _ALIKE
    ]
    return Turn(alike, before, after) if before > max(_APART, _TIMES * after) else None
