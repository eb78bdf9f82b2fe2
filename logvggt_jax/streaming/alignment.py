"""Two predictions of the same frames, each in a world and unit of its own, carried onto one another."""

from __future__ import annotations

import numpy as np

from logvggt_jax.frames import evenly_spaced
from logvggt_jax.geometry import NoSimilarity, Similarity, robust_similarity, unproject_pixels
from logvggt_jax.streaming.offline import PlainPrediction

# Shared pixels that fit a similarity: seven numbers need no more, and every chunk solves for them six times.
_MOST_POINTS = 200_000
# Pixels less confident than this share of the median are left out.
_LEAST_CONFIDENCE = 0.1
# Residuals count linearly beyond this share of the median depth.
_HUBER_THRESHOLD = 0.1


def align(source: PlainPrediction, target: PlainPrediction) -> Similarity:
    """The similarity that carries one prediction of some frames onto another of the same frames.

    It fits the points of the same pixels where both are confident, weighted by the geometric mean of both
    confidences, with Huber weights against what the predictions disagree about.

    Raises:
      NoSimilarity: fewer than three pixels are valid in both, or their points lie on a line.
    """
    valid = confident(source, target)
    chosen = _some(valid)
    if len(chosen) < 3:
        raise NoSimilarity(f"{len(chosen)} of {valid.size} pixels have a valid depth and confidence in both")
    weights = np.sqrt(source.depth_confidence.reshape(-1)[chosen].astype(np.float64))
    weights *= np.sqrt(target.depth_confidence.reshape(-1)[chosen].astype(np.float64))
    threshold = _HUBER_THRESHOLD * float(np.median(target.depth.reshape(-1)[chosen]))
    clouds = [unproject_pixels(each.depth, each.intrinsics, each.extrinsics, chosen) for each in (source, target)]
    return robust_similarity(clouds[0], clouds[1], weights, threshold=threshold)


def residual(source: PlainPrediction, target: PlainPrediction) -> float:
    """How far two predictions of the same frames in one world are apart: the median distance between both points of a
    pixel where both are confident, as a fraction of the median depth; NaN where there is no such pixel."""
    chosen = _some(confident(source, target))
    if not len(chosen):
        return float("nan")
    clouds = [unproject_pixels(each.depth, each.intrinsics, each.extrinsics, chosen) for each in (source, target)]
    distance = np.median(np.linalg.norm(clouds[0] - clouds[1], axis=1))
    return float(distance / np.median(target.depth.reshape(-1)[chosen]))


def move(prediction: PlainPrediction, similarity: Similarity) -> PlainPrediction:
    """The same prediction in the world and unit that `similarity` maps to; float32."""
    points = prediction.points
    return prediction._replace(
        depth=(similarity.scale * prediction.depth).astype(np.float32),
        extrinsics=similarity.apply_to_extrinsics(prediction.extrinsics).astype(np.float32),
        points=None if points is None else similarity.apply(points).astype(np.float32),
        pose_encoding=None,
    )


def confident(source: PlainPrediction, target: PlainPrediction) -> np.ndarray:
    """Pixels [n, H, W] that both predictions know something of."""
    valid = np.ones(source.depth.shape, bool)
    for prediction in (source, target):
        valid &= np.isfinite(prediction.depth) & (prediction.depth > 0) & np.isfinite(prediction.depth_confidence)
    if valid.any():
        least = _LEAST_CONFIDENCE * min(float(np.median(p.depth_confidence[valid])) for p in (source, target))
        valid &= (source.depth_confidence > least) & (target.depth_confidence > least)
    return valid


def _some(valid: np.ndarray) -> np.ndarray:
    """Flat places of `valid`, at most `_MOST_POINTS`, evenly spread."""
    chosen = np.flatnonzero(valid)
    return chosen[evenly_spaced(len(chosen), _MOST_POINTS)]
