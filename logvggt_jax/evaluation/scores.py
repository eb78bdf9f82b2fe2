"""What is measured on one clip, and how a benchmark's score is made of clips."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from logvggt_jax.evaluation.clips import ClipData
from logvggt_jax.evaluation.methods.method import ClipPrediction, Method
from logvggt_jax.evaluation.progress import track
from logvggt_jax.evaluation.protocols.protocol import DepthMeasure, PointsMeasure, Protocol
from logvggt_jax.evaluation.scratch import scratch_array
from logvggt_jax.geometry import NoSimilarity, camera_centres, invert, umeyama, unproject_pixels
from logvggt_jax.metrics.depth import DEPTH_KEYS, mean_depth_metrics, pixel_errors, resize_depth, valid_depth
from logvggt_jax.metrics.errors import NotMeasurable
from logvggt_jax.metrics.points import estimate_normals, point_cloud_metrics, sample_indices
from logvggt_jax.metrics.pose import pose_accuracy, relative_pose_errors
from logvggt_jax.metrics.trajectory import rms_radius, trajectory_errors

POINT_KEYS = (
    "acc_mean",
    "acc_median",
    "comp_mean",
    "comp_median",
    "nc_mean",
    "nc_median",
    "chamfer_sum",
    "chamfer_mean",
)
ACCURACY_KEYS = ("rra@5", "rra@30", "rta@30", "auc@30")
POSE_KEYS = (*ACCURACY_KEYS, "rotation_error", "identity_rotation_error")
TRAJECTORY_KEYS = ("ate", "ate_ratio", "rpe_translation", "rpe_rotation")
# `scale` (one scale a clip) is what the paper's tables are compared with.
_ALIGNMENTS = ("scale", "median")
# Errors against a second set of true poses carry this before their names.
SFM = "sfm/"


@dataclasses.dataclass(frozen=True)
class TruePoses:
    """One set of true poses of a clip."""

    extrinsics: np.ndarray  # [T, 4, 4], world-to-camera

    @functools.cached_property
    def identity_rotation_error(self) -> float:
        """Mean rotation error in degrees over all pairs of frames of a camera that never moves."""
        rotation, _ = relative_pose_errors(np.tile(np.eye(4), (len(self.extrinsics), 1, 1)), self.extrinsics)
        return float(rotation.mean())


@dataclasses.dataclass(frozen=True)
class ClipTruth:
    """Ground truth of one clip, prepared once for all methods."""

    clip: ClipData  # the clip
    # [N] flat indices into [T, H, W] of the pixels whose points are compared; the same for prediction and truth. None
    # where points are not measured.
    indices: np.ndarray | None = None
    points: np.ndarray | None = None  # [N, 3] in the data set's world
    normals: np.ndarray | None = None  # [N, 3]

    @functools.cached_property
    def poses(self) -> dict[str, TruePoses]:
        """Sets of true poses, by what stands before the names of errors against them."""
        sets = {"": self.clip.extrinsics, SFM: self.clip.sfm_extrinsics}
        return {prefix: TruePoses(extrinsics) for prefix, extrinsics in sets.items() if extrinsics is not None}


@dataclasses.dataclass(frozen=True)
class ClipScore:
    """Metrics of one method on one clip, and why the missing ones are missing, by group of metrics."""

    metrics: dict[str, float]
    failures: dict[str, str]


def is_measured(method: Method, protocol: Protocol) -> bool:
    """Whether the protocol measures anything that the method claims."""
    return bool(
        (method.depth and protocol.depth)
        or (method.points and protocol.points)
        or (method.pose and (protocol.poses or protocol.trajectory))
    )


def prepare_truth(clip: ClipData, points: PointsMeasure | None) -> ClipTruth:
    """The clip's true points, at most `max_points` of those with a valid depth, and their normals."""
    if points is None or clip.depth is None or not np.isfinite(clip.extrinsics).all():
        return ClipTruth(clip)
    indices = valid_indices(clip.depth, points)
    if not indices.size:
        return ClipTruth(clip)
    cloud = unproject_pixels(clip.depth, clip.intrinsics, clip.extrinsics, indices)
    return ClipTruth(clip, indices, cloud, estimate_normals(cloud))


def clip_score(method: Method, prediction: ClipPrediction, truth: ClipTruth, protocol: Protocol) -> ClipScore:
    """All metrics that the protocol asks for and the method claims.

    A group of metrics that cannot be computed (nothing valid, no pose, a trajectory without alignment, a prediction
    that is not finite) is left out and its reason returned; nothing is replaced by a number.
    """
    groups: list[tuple[str, Callable[[], dict[str, float]]]] = []
    depth, points = protocol.depth, protocol.points
    if depth is not None and method.depth:
        groups.append(("depth", lambda: _depth(prediction, truth.clip, depth)))
    for prefix, true in truth.poses.items() if method.pose else ():
        if protocol.poses:
            groups.append((f"{prefix}pose", functools.partial(_pose, prediction, true)))
        if protocol.trajectory:
            trajectory = functools.partial(_trajectory, prediction, true.extrinsics, method.static)
            groups.append((f"{prefix}trajectory", trajectory))
    if points is not None and method.points:
        groups.append(("points", lambda: _points(prediction, truth, points.icp_threshold)))
    metrics: dict[str, float] = {}
    failures: dict[str, str] = {}
    for name, measure in groups:
        prefix = SFM if name.startswith(SFM) else ""
        try:
            metrics |= {prefix + key: value for key, value in measure().items()}
        except NotMeasurable as error:
            failures[name] = str(error)
    return ClipScore(metrics, failures)


def benchmark_score(
    protocol: Protocol, method: Method, scores: Sequence[tuple[str, ClipScore]], planned: int
) -> dict[str, float]:
    """Means over the clips that were predicted (sequence and score); metrics without any clip are absent.

    Depth is weighted by valid pixels, all else plain, but relative poses of a `pooled` protocol: their pairs are pooled
    within a category, and the mean is over categories. `rotation_ratio` is the mean rotation error over the mean that
    no motion at all would have. Besides: `clips`, the number `planned`, those included that could not be read or
    predicted; `clips_measured`, of how many anything is known; and `clips_depth`, `clips_pose`, `clips_trajectory`,
    `clips_points` (and with `sfm/`), how many of them are in each mean, for the groups that method and protocol
    measure.
    """
    result: dict[str, float] = {"clips": planned, "clips_measured": sum(bool(score.metrics) for _, score in scores)}
    if protocol.depth is not None and method.depth:
        result |= _depth_means([score.metrics for _, score in scores])
    second = any(key.startswith(SFM) for _, score in scores for key in score.metrics)
    for prefix in ("", SFM) if second else ("",):
        if protocol.poses and method.pose:
            result |= _pose_means(scores, prefix, protocol.pooled)
        if protocol.trajectory and method.pose:
            result |= _plain_means(scores, f"{prefix}trajectory", [prefix + key for key in TRAJECTORY_KEYS])
    if protocol.points is not None and method.points:
        result |= _plain_means(scores, "points", POINT_KEYS)
    return result


def valid_indices(depth: np.ndarray, points: PointsMeasure) -> np.ndarray:
    """Sorted flat indices [N] into [T, H, W] of the pixels whose points are compared.

    One frame at a time is searched, so that memory grows with the points drawn and not with the clip.
    """
    crop = _middle(depth.shape[1:], points.crop)
    counts = np.array([int((frame[crop] > 0).sum()) for frame in depth])
    ranks = sample_indices(int(counts.sum()), points.max_points, points.seed)
    borders = np.concatenate([[0], np.cumsum(counts)])
    edges = np.searchsorted(ranks, borders)
    grid = np.arange(depth[0].size).reshape(depth.shape[1:])[crop]
    chosen = [
        grid[frame[crop] > 0][ranks[edges[t] : edges[t + 1]] - borders[t]] + t * frame.size
        for t, frame in enumerate(depth)
    ]
    return np.concatenate(chosen)


def valid_pixels(prediction: np.ndarray, target: np.ndarray, max_depth: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Predicted and true depth [N] of a clip's valid pixels, in order, on disk where they are many.

    The prediction [T, h, w] is resized frame by frame, as `resize_depth` does, where its size is not that of the target
    [T, H, W]; both may be memory maps, of which one frame is in memory at a time. Depth from `max_depth` metres on is
    not valid; None for no bound.
    """
    count = sum(int(valid_depth(frame, max_depth).sum()) for frame in target)
    predicted, true = scratch_array((count,), prediction.dtype), scratch_array((count,), target.dtype)
    start = 0
    for shown, frame in zip(prediction, track(target, len(target), "valid depth"), strict=True):
        valid = valid_depth(frame, max_depth)
        stop = start + int(valid.sum())
        if shown.shape != frame.shape:
            shown = resize_depth(shown[None], frame.shape)[0]
        predicted[start:stop], true[start:stop] = shown[valid], frame[valid]
        start = stop
    return predicted, true


def aligned_points(prediction: ClipPrediction, truth: ClipTruth) -> np.ndarray:
    """Predicted points [N, 3] of the compared pixels, moved by the similarity that fits the true ones best.

    Raises NotMeasurable without true points, a finite prediction or a similarity; ValueError where the method predicts
    no depth or intrinsics, or depth of another size.
    """
    if truth.indices is None or truth.points is None or truth.clip.depth is None:
        raise NotMeasurable("the clip has no true points (no valid depth or no true poses)")
    depth = _finite_depth(prediction)
    if depth.shape != truth.clip.depth.shape:
        raise ValueError(f"predicted depth {depth.shape} must have the shape of the true one {truth.clip.depth.shape}")
    if prediction.intrinsics is None:
        raise ValueError("points need predicted intrinsics")
    cloud = unproject_pixels(depth, prediction.intrinsics, prediction.extrinsics, truth.indices)
    try:
        return umeyama(cloud, truth.points).apply(cloud)
    except NoSimilarity as error:
        raise NotMeasurable(f"predicted points cannot be aligned: {error}") from error


def _middle(size: tuple[int, ...], crop: int | None) -> tuple[slice, slice]:
    """Rows and columns of the middle crop x crop pixels of pictures (H, W); all where there is no crop."""
    if crop is None:
        return slice(None), slice(None)
    rows, columns = (slice(max(0, edge // 2 - crop // 2), edge // 2 + crop // 2) for edge in size)
    return rows, columns


def _depth(prediction: ClipPrediction, clip: ClipData, measure: DepthMeasure) -> dict[str, float]:
    """`<alignment>/<error>` of predicted depth [T, h, w] against the true [T, H, W], and `valid_pixels`."""
    depth = _finite_depth(prediction)
    assert clip.depth is not None  # read where the protocol measures depth
    pixels = valid_pixels(depth, clip.depth, measure.max_depth)
    if not pixels[0].size:
        raise NotMeasurable("no frame of the clip has a valid depth")
    result: dict[str, float] = {}
    for alignment in _ALIGNMENTS:
        errors = pixel_errors(*pixels, alignment=alignment, clip=measure.clip)
        result |= {f"{alignment}/{key}": errors[key] for key in DEPTH_KEYS}
        result["valid_pixels"] = errors["valid_pixels"]
    if not np.isfinite(list(result.values())).all():
        raise NotMeasurable("predicted depth cannot be aligned: it is 0 at every valid pixel, or its scale overflows")
    return result


def _pose(prediction: ClipPrediction, true: TruePoses) -> dict[str, float]:
    """Means over all pairs of frames."""
    rotation, translation = relative_pose_errors(prediction.extrinsics, true.extrinsics)
    wide = pose_accuracy(rotation, translation, 30)
    return {
        "rra@5": pose_accuracy(rotation, translation, 5)["rra"],
        "rra@30": wide["rra"],
        "rta@30": wide["rta"],
        "auc@30": wide["auc"],
        "rotation_error": float(rotation.mean()),
        "identity_rotation_error": true.identity_rotation_error,
        "pairs": float(len(rotation)),
    }


def _trajectory(prediction: ClipPrediction, extrinsics: np.ndarray, static: bool) -> dict[str, float]:
    """Errors of camera positions, against true world-to-camera extrinsics [T, 4, 4]; metres where the set is metric."""
    true = np.asarray(extrinsics, np.float64)
    radius = rms_radius(camera_centres(true))
    if static:
        if not radius > 0:
            raise NotMeasurable("the true camera does not move or has no pose")
        return {"ate": radius, "ate_ratio": 1.0}
    errors = trajectory_errors(invert(np.asarray(prediction.extrinsics, np.float64)), invert(true))
    return {**errors, "ate_ratio": errors["ate"] / radius}


def _points(prediction: ClipPrediction, truth: ClipTruth, icp_threshold: float | None) -> dict[str, float]:
    """Errors of the aligned cloud [N, 3] against the true one; metres where the set is metric."""
    cloud = aligned_points(prediction, truth)
    assert truth.points is not None  # aligned_points has looked
    return point_cloud_metrics(cloud, truth.points, target_normals=truth.normals, icp_threshold=icp_threshold)


def _finite_depth(prediction: ClipPrediction) -> np.ndarray:
    """Predicted depth [T, h, w]; NotMeasurable where a value is not finite."""
    depth = prediction.depth
    if depth is None:
        raise ValueError("the method predicts no depth")
    bad = [t for t, frame in enumerate(depth) if not np.isfinite(frame).all()]
    if bad:
        raise NotMeasurable(f"predicted depth of frame {bad[0]} is not finite ({len(bad)} such frames)")
    return depth


def _depth_means(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the clips that have depth errors, weighted by valid pixels."""
    measured = [m for m in metrics if "valid_pixels" in m]
    result: dict[str, float] = {"clips_depth": len(measured)}
    for alignment in _ALIGNMENTS:
        clips = [
            {key: m[f"{alignment}/{key}"] for key in DEPTH_KEYS} | {"valid_pixels": m["valid_pixels"]} for m in measured
        ]
        if clips:
            means = mean_depth_metrics(clips)
            result |= {f"{alignment}/{key}": means[key] for key in DEPTH_KEYS}
            result["valid_pixels"] = means["valid_pixels"]
    return result


def _pose_means(scores: Sequence[tuple[str, ClipScore]], prefix: str, pooled: bool) -> dict[str, float]:
    """Means over clips (pooled: over the pairs of a category, then over categories) of the metrics with a prefix."""
    keys = [prefix + key for key in POSE_KEYS]
    result = _plain_means(scores, f"{prefix}pose", keys)
    measured = [(name, score.metrics) for name, score in scores if keys[0] in score.metrics]
    if pooled and measured:
        categories: dict[str, list[Mapping[str, float]]] = {}
        for name, metrics in measured:
            categories.setdefault(name.split("/")[0], []).append(metrics)
        # Every one of these is a mean over pairs, so that pooling pairs is weighting by their number.
        for key in keys:
            means = [
                np.average([m[key] for m in group], weights=[m[f"{prefix}pairs"] for m in group])
                for group in categories.values()
            ]
            result[key] = float(np.mean(means))
        result[f"{prefix}categories"] = len(categories)
    if result.get(f"{prefix}identity_rotation_error"):
        ratio = result[f"{prefix}rotation_error"] / result[f"{prefix}identity_rotation_error"]
        result[f"{prefix}rotation_ratio"] = ratio
    return result


def _plain_means(scores: Sequence[tuple[str, ClipScore]], group: str, keys: Sequence[str]) -> dict[str, float]:
    """Means of `keys` over the clips that have the first of them, and how many those are."""
    measured = [score.metrics for _, score in scores if keys[0] in score.metrics]
    result: dict[str, float] = {f"clips_{group}": len(measured)}
    for key in keys:
        values = [m[key] for m in measured if key in m]
        if values:
            result[key] = float(np.mean(values))
    return result
