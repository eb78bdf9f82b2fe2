"""Similarity transforms between corresponding points (numpy, float64): Umeyama and a robust variant."""

from typing import NamedTuple

import numpy as np

from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry.cameras import camera_centres
from logvggt_jax.geometry.rotations import nearest_rotation, rotation_angle

# Of reweighting cameras.
_ROUNDS = 20


class NoSimilarity(ValueError):
    """What is to be aligned has no similarity, or more than one: too few points, points on a line, nothing that moves.

    Arrays of wrong shapes are plain ValueErrors: those are faults of the caller.
    """


class Similarity(NamedTuple):
    """y = scale * rotation @ x + translation; rotation [3, 3], translation [3], float64."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        """[4, 4] float64."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transforms points [..., 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_extrinsics(self, extrinsics: np.ndarray) -> np.ndarray:
        """World-to-camera matrices [..., 3|4, 4] of the same cameras after `apply` has moved the world.

        What a camera sees at depth d it then sees at depth `scale` * d.
        """
        moved = np.array(extrinsics, np.float64)
        moved[..., :3, :3] = extrinsics[..., :3, :3] @ self.rotation.T
        moved[..., :3, 3] = self.scale * extrinsics[..., :3, 3] - moved[..., :3, :3] @ self.translation
        return moved


def umeyama(source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None) -> Similarity:
    """Least-squares similarity that maps `source` [N, 3] onto `target` [N, 3] (Umeyama 1991).

    Optional `weights` [N]. Raises NoSimilarity for fewer than three points or points on a line, where no unique one
    exists. The degeneracy test is relative, so tiny trajectories are not refused.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"need two [N, 3] arrays of corresponding points, got {source.shape} and {target.shape}")
    if len(source) < 3:
        raise NoSimilarity(f"a similarity needs at least 3 corresponding points, got {len(source)}")
    w = np.full(len(source), 1.0 / len(source)) if weights is None else np.asarray(weights, np.float64)
    w = w / w.sum()
    mean_source, mean_target = w @ source, w @ target
    centred_source, centred_target = source - mean_source, target - mean_target
    variance = float(w @ (centred_source**2).sum(1))
    spread = np.sqrt(variance * float(w @ (centred_target**2).sum(1)))
    if not np.isfinite(spread):
        raise NoSimilarity("no similarity: a point or weight is not finite")
    covariance = (centred_target * w[:, None]).T @ centred_source
    u, singular, vt = np.linalg.svd(covariance)
    if singular[1] <= 1e-12 * max(spread, np.finfo(np.float64).tiny):
        raise NoSimilarity("no unique similarity: the points coincide or lie on one line")
    sign = np.ones(3)
    sign[2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign) @ vt
    scale = float(singular @ sign) / variance
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def robust_similarity(
    source: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    threshold: float = 0.1,
    iterations: int = 5,
) -> Similarity:
    """Umeyama reweighted with Huber weights, for points with outliers.

    `threshold` is the residual in units of `target` beyond which a point's influence stops growing.
    """
    base = np.ones(len(source)) if weights is None else np.asarray(weights, np.float64)
    similarity = umeyama(source, target, base)
    for _ in range(iterations):
        residual = np.linalg.norm(similarity.apply(np.asarray(source, np.float64)) - target, axis=1)
        similarity = umeyama(source, target, base * np.minimum(1.0, threshold / np.maximum(residual, 1e-12)))
    return similarity


def pose_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The similarity that moves the world so that cameras `source` come to lie where cameras `target` are.

    Robust: a minority of wrong poses loses its weight. Rotations give the rotation and centres the rest, so that a
    straight path, on which centres alone leave a rotation open, is enough. The scale is the ratio of how far centres
    lie apart in both worlds: least squares would make it too small by as much as the paths differ in shape, or too
    large the other way round.

    Args:
      source: [N, 3|4, 4] world-to-camera.
      target: [N, 3|4, 4] of the same cameras in another world.

    Raises:
      NoSimilarity: fewer than two cameras, or centres that coincide, which have no scale.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if len(source) < 2:
        raise NoSimilarity(f"a similarity of cameras needs at least 2, got {len(source)}")
    rotation = _central_rotation(np.swapaxes(target[:, :3, :3], -1, -2) @ source[:, :3, :3])
    turned, centres = camera_centres(source) @ rotation.T, camera_centres(target)
    # Of camera i and the one half the sequence on: long ways, of which most are right.
    partner = np.roll(np.arange(len(source)), len(source) // 2)
    lengths = np.linalg.norm(turned - turned[partner], axis=1)
    moved = lengths > 1e-9 * max(float(np.abs(turned).max()), np.finfo(np.float64).tiny)
    if not moved.any():
        raise NoSimilarity("no similarity: the cameras are all at one place, which leaves the scale open")
    scale = float(np.median(np.linalg.norm(centres - centres[partner], axis=1)[moved] / lengths[moved]))
    translation = np.median(centres - scale * turned, axis=0)
    for _ in range(_ROUNDS):
        residual = np.linalg.norm(scale * turned + translation - centres, axis=1)
        # Where most fit exactly, the others have no weight worth the name.
        limit = max(1.5 * float(np.median(residual)), 1e-12 * float(np.abs(centres).max()), np.finfo(np.float64).tiny)
        weights = np.minimum(1.0, limit / np.maximum(residual, limit)) ** 2
        weights /= weights.sum()
        mean_source, mean_target = weights @ turned, weights @ centres
        of_source = float(weights @ ((turned - mean_source) ** 2).sum(1))
        of_target = float(weights @ ((centres - mean_target) ** 2).sum(1))
        if not (of_source > 0 and of_target > 0):
            raise NoSimilarity("no similarity: the cameras are all at one place, which leaves the scale open")
        scale = float(np.sqrt(of_target / of_source))
        translation = mean_target - scale * mean_source
    return Similarity(scale, rotation, translation)


def _central_rotation(rotations: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that is nearest to most of `rotations` [N, 3, 3]: a mean with weights one over the angle."""
    candidates = rotations[evenly_spaced(len(rotations), 64)]
    between = rotation_angle(candidates[:, None], rotations[None])
    centre = candidates[np.median(between, axis=1).argmin()]
    for _ in range(_ROUNDS):
        weights = 1 / np.maximum(rotation_angle(centre[None], rotations), 1e-6)
        centre = nearest_rotation((weights[:, None, None] * rotations).sum(0) / weights.sum())
    return centre
