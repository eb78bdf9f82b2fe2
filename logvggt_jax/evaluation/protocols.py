"""What is measured on one clip, and how a data set's score is made of clips."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from logvggt_jax.evaluation.depth import DEPTH_KEYS, depth_metrics, mean_depth_metrics
from logvggt_jax.evaluation.methods import ClipPrediction, Method
from logvggt_jax.evaluation.points import estimate_normals, point_cloud_metrics, sample_indices
from logvggt_jax.evaluation.pose import pose_accuracy, relative_pose_errors
from logvggt_jax.evaluation.trajectory import rms_radius, trajectory_errors
from logvggt_jax.geometry import camera_centres, invert, umeyama, unproject
from logvggt_jax.types import Frames

DEPTH_ALIGNMENTS = ("scale", "median")
POINT_KEYS = ("acc_mean", "acc_median", "comp_mean", "comp_median", "nc_mean", "nc_median")
POSE_KEYS = ("rra@5", "rra@30", "rta@30", "auc@30", "rotation_error", "identity_rotation_error")
TRAJECTORY_KEYS = ("ate", "ate_ratio")


@dataclasses.dataclass(frozen=True)
class ClipTruth:
    """Ground truth of one clip, prepared once for all methods.

    Attributes:
      frames: the clip.
      indices: [N] flat indices into [T, H, W] of the pixels whose points are compared; the same for prediction and
        truth. None where points are not measured.
      points: [N, 3] in the data set's world.
      normals: [N, 3].
    """

    frames: Frames
    indices: np.ndarray | None = None
    points: np.ndarray | None = None
    normals: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class ClipScore:
    """Metrics of one method on one clip, and why the missing ones are missing, by group of metrics."""

    metrics: dict[str, float]
    failures: dict[str, str]


def prepare_truth(frames: Frames, *, max_points: int | None, seed: int, points: bool = True) -> ClipTruth:
    """The clip's true points, at most `max_points` of those with a valid depth, and their normals."""
    if not points or not np.isfinite(frames.extrinsics).all():
        return ClipTruth(frames)
    valid = np.flatnonzero(frames.depth > 0)
    if not valid.size:
        return ClipTruth(frames)
    indices = valid[sample_indices(valid.size, max_points, seed)]
    cloud = points_at(frames.depth, frames.intrinsics, frames.extrinsics, indices)
    return ClipTruth(frames, indices, cloud, estimate_normals(cloud))


def clip_score(
    method: Method, prediction: ClipPrediction, truth: ClipTruth, *, icp_threshold: float | None = 0.1
) -> ClipScore:
    """All metrics of a prediction that its method claims.

    A group of metrics that cannot be computed (nothing valid, no pose, a trajectory without alignment, a prediction
    that is not finite) is left out and its reason returned; nothing is replaced by a number.
    """
    groups: list[tuple[str, Callable[[], dict[str, float]]]] = []
    if method.depth:
        groups.append(("depth", lambda: _depth(prediction, truth)))
    if method.pose:
        groups.append(("pose", lambda: _pose(prediction, truth)))
        groups.append(("trajectory", lambda: _trajectory(prediction, truth, static=method.static)))
    if method.points:
        groups.append(("points", lambda: _points(prediction, truth, icp_threshold)))
    metrics: dict[str, float] = {}
    failures: dict[str, str] = {}
    for name, measure in groups:
        try:
            metrics.update(measure())
        except ValueError as error:
            failures[name] = str(error)
    return ClipScore(metrics, failures)


def data_set_score(scores: Sequence[ClipScore]) -> dict[str, float]:
    """Means over clips: depth weighted by valid pixels, all else plain; metrics without any clip are absent.

    `rotation_ratio` is the mean rotation error over the mean that no motion at all would have. `clips` is the number
    of clips, `clips_depth`, `clips_pose`, `clips_trajectory` and `clips_points` how many of them are in each mean.
    """
    result: dict[str, float] = {"clips": len(scores)}
    metrics = [score.metrics for score in scores]
    for alignment in DEPTH_ALIGNMENTS:
        keys = {key: f"{alignment}/{key}" for key in DEPTH_KEYS}
        measured = [m for m in metrics if keys["abs_rel"] in m]
        result["clips_depth"] = len(measured)
        if measured:
            clips = [
                {key: m[name] for key, name in keys.items()} | {"valid_pixels": m["valid_pixels"]} for m in measured
            ]
            means = mean_depth_metrics(clips)
            result |= {name: means[key] for key, name in keys.items()} | {"valid_pixels": means["valid_pixels"]}
    for group, names in (("pose", POSE_KEYS), ("trajectory", TRAJECTORY_KEYS), ("points", POINT_KEYS)):
        measured = [m for m in metrics if names[0] in m]
        result[f"clips_{group}"] = len(measured)
        if measured:
            result |= {name: float(np.mean([m[name] for m in measured])) for name in names}
    if result.get("identity_rotation_error"):
        result["rotation_ratio"] = result["rotation_error"] / result["identity_rotation_error"]
    return result


def points_at(depth: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """World points [N, 3] float64 of the pixels `indices` [N] (sorted, flat in [T, H, W]).

    One frame at a time, so that a long clip never has all its points in memory.
    """
    pixels = depth.shape[1] * depth.shape[2]
    borders = np.searchsorted(indices, np.arange(len(depth) + 1) * pixels)
    clouds = []
    for t in range(len(depth)):
        frame = unproject(
            np.asarray(depth[t], np.float64),
            np.asarray(intrinsics[t], np.float64),
            np.asarray(extrinsics[t], np.float64),
        )
        clouds.append(frame.reshape(-1, 3)[indices[borders[t] : borders[t + 1]] - t * pixels])
    return np.concatenate(clouds)


def _depth(prediction: ClipPrediction, truth: ClipTruth) -> dict[str, float]:
    depth = _finite_depth(prediction)
    if not (truth.frames.depth > 0).any():
        raise ValueError("no frame of the clip has a valid depth")
    result: dict[str, float] = {}
    for alignment in DEPTH_ALIGNMENTS:
        errors = depth_metrics(depth, truth.frames.depth, alignment=alignment)
        result |= {f"{alignment}/{key}": errors[key] for key in DEPTH_KEYS} | {"valid_pixels": errors["valid_pixels"]}
    return result


def _pose(prediction: ClipPrediction, truth: ClipTruth) -> dict[str, float]:
    true = truth.frames.extrinsics
    rotation, translation = relative_pose_errors(prediction.extrinsics, true)
    identity_rotation, _ = relative_pose_errors(np.tile(np.eye(4), (len(true), 1, 1)), true)
    wide = pose_accuracy(rotation, translation, 30)
    return {
        "rra@5": pose_accuracy(rotation, translation, 5)["rra"],
        "rra@30": wide["rra"],
        "rta@30": wide["rta"],
        "auc@30": wide["auc"],
        "rotation_error": float(rotation.mean()),
        "identity_rotation_error": float(identity_rotation.mean()),
    }


def _trajectory(prediction: ClipPrediction, truth: ClipTruth, *, static: bool) -> dict[str, float]:
    true = np.asarray(truth.frames.extrinsics, np.float64)
    radius = rms_radius(camera_centres(true))
    if static:
        if not radius > 0:
            raise ValueError("the true camera does not move or has no pose")
        return {"ate": radius, "ate_ratio": 1.0}
    ate = trajectory_errors(invert(np.asarray(prediction.extrinsics, np.float64)), invert(true))["ate"]
    return {"ate": ate, "ate_ratio": ate / radius}


def _points(prediction: ClipPrediction, truth: ClipTruth, icp_threshold: float | None) -> dict[str, float]:
    if truth.indices is None or truth.points is None:
        raise ValueError("the clip has no true points (no valid depth or no true poses)")
    depth = _finite_depth(prediction)
    if prediction.intrinsics is None:
        raise ValueError("points need predicted intrinsics")
    cloud = points_at(depth, prediction.intrinsics, prediction.extrinsics, truth.indices)
    aligned = umeyama(cloud, truth.points).apply(cloud)
    metrics = point_cloud_metrics(aligned, truth.points, target_normals=truth.normals, icp_threshold=icp_threshold)
    return {key: metrics[key] for key in POINT_KEYS}


def _finite_depth(prediction: ClipPrediction) -> np.ndarray:
    depth = prediction.depth
    if depth is None:
        raise ValueError("the method predicts no depth")
    bad = np.flatnonzero(~np.isfinite(depth).all((1, 2)))
    if bad.size:
        raise ValueError(f"predicted depth of frame {bad[0]} is not finite ({bad.size} such frames)")
    return depth
