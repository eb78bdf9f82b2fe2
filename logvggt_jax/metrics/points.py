"""Reconstruction: accuracy, completeness, normal consistency and Chamfer distance of point clouds.

Source: the evaluation code of CUT3R and its descendants (`eval/mv_recon`); ICP and normals by Open3D, nearest
neighbours by SciPy.
"""

import ctypes
import importlib
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from logvggt_jax.errors import MissingPackage, install_line
from logvggt_jax.metrics.errors import NotMeasurable


def point_cloud_metrics(
    prediction: np.ndarray,
    target: np.ndarray,
    *,
    prediction_normals: np.ndarray | None = None,
    target_normals: np.ndarray | None = None,
    icp_threshold: float | None = 0.1,
) -> dict[str, float]:
    """Distances and normal agreement of a predicted and a true point cloud that are already roughly aligned.

    Args:
      prediction: [N, 3] points.
      target: [M, 3] points in the same frame and unit (metres, if ICP is to use its usual threshold).
      prediction_normals: [N, 3] unit normals of any sign; without them they are estimated from the 30 nearest
        points.
      target_normals: [M, 3], likewise.
      icp_threshold: largest distance of corresponding points in the rigid ICP that moves the prediction
        first; None leaves it where it is.

    Returns:
      `acc_mean`, `acc_median`: distance of predicted points to the nearest true point; `comp_mean`,
      `comp_median`: of true points to the nearest predicted point; `nc_mean`, `nc_median`: |cosine| between
      the normals of nearest neighbours, averaged over both directions; `chamfer_sum` = acc_mean + comp_mean
      and `chamfer_mean`, half of it (the papers do not say which they mean).

    Raises:
      NotMeasurable: an empty cloud, points that are not finite.
      ValueError: wrong shapes, an `icp_threshold` that is not above 0.
      MissingPackage: Open3D (ICP, normals) is not installed.
    """
    if icp_threshold is not None and not icp_threshold > 0:  # NaN as well, with which nothing would move
        raise ValueError(f"icp_threshold must be a distance above 0, or None for no ICP, got {icp_threshold}")
    prediction, target = _cloud(prediction, "prediction"), _cloud(target, "target")
    if prediction_normals is not None:
        prediction_normals = _normals_of(prediction, prediction_normals, "prediction_normals")
    if target_normals is not None:
        target_normals = _normals_of(target, target_normals, "target_normals")
    if icp_threshold is not None:
        motion = register_icp(prediction, target, icp_threshold)
        prediction = prediction @ motion[:3, :3].T + motion[:3, 3]
        if prediction_normals is not None:
            prediction_normals = prediction_normals @ motion[:3, :3].T
    if prediction_normals is None:
        prediction_normals = estimate_normals(prediction)
    if target_normals is None:
        target_normals = estimate_normals(target)

    accuracy, nearest_target = _nearest(prediction, target)
    completeness, nearest_prediction = _nearest(target, prediction)
    cosine_accuracy = np.abs((prediction_normals * target_normals[nearest_target]).sum(-1))
    cosine_completeness = np.abs((target_normals * prediction_normals[nearest_prediction]).sum(-1))
    return {
        "acc_mean": float(accuracy.mean()),
        "acc_median": float(np.median(accuracy)),
        "comp_mean": float(completeness.mean()),
        "comp_median": float(np.median(completeness)),
        "nc_mean": float((cosine_accuracy.mean() + cosine_completeness.mean()) / 2),
        "nc_median": float((np.median(cosine_accuracy) + np.median(cosine_completeness)) / 2),
        "chamfer_sum": float(accuracy.mean() + completeness.mean()),
        "chamfer_mean": float((accuracy.mean() + completeness.mean()) / 2),
    }


def register_icp(prediction: np.ndarray, target: np.ndarray, threshold: float) -> np.ndarray:
    """Rigid motion [4, 4] by point-to-point ICP from the identity: at most 30 iterations, tolerances 1e-6."""
    open3d = _open3d()
    registration = open3d.pipelines.registration
    result = registration.registration_icp(
        _open3d_cloud(prediction),
        _open3d_cloud(target),
        threshold,
        np.eye(4),
        registration.TransformationEstimationPointToPoint(),
    )
    return np.array(result.transformation)


def estimate_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals [N, 3] of unknown sign from the 30 nearest points (all of them where there are fewer)."""
    cloud = _open3d_cloud(points)
    cloud.estimate_normals()
    return np.array(cloud.normals)


def sample_indices(count: int, max_points: int | None, seed: int) -> np.ndarray:
    """Sorted indices [min(count, max_points)] drawn without replacement; all where `max_points` is None.

    Prediction and ground truth of corresponding points have to be reduced by the same indices.
    """
    if max_points is None or count <= max_points:
        return np.arange(count)
    return np.sort(np.random.default_rng(seed).choice(count, max_points, replace=False))


def _nearest(points: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] of each of `points` [N, 3] to the nearest of `others` [M, 3], and its index [N]."""
    return cKDTree(others).query(points)


def _cloud(points: np.ndarray, name: str) -> np.ndarray:
    """A cloud as float64 [N, 3]; ValueError for another shape, NotMeasurable where it is empty or not finite."""
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name} must be a cloud [N, 3], got shape {points.shape}")
    if not len(points):
        raise NotMeasurable(f"{name} has no points")
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    if bad.size:
        raise NotMeasurable(f"{name}: point {bad[0]} is not finite ({bad.size} such points)")
    return points


def _normals_of(points: np.ndarray, normals: np.ndarray, name: str) -> np.ndarray:
    """Normals as float64 [N, 3]; ValueError unless there is one for each point."""
    normals = np.asarray(normals, np.float64)
    if normals.shape != points.shape:
        raise ValueError(f"{name} must have the shape of its points {points.shape}, got {normals.shape}")
    return normals


def _open3d_cloud(points: np.ndarray) -> Any:
    open3d = _open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.ascontiguousarray(points)))


def _open3d() -> Any:
    try:
        try:
            return importlib.import_module("open3d")
        except ImportError as error:
            if "libusb" not in str(error):
                raise
            # Open3D's wheels link libusb, which bare machines lack; the libusb-package wheel brings it.
            path = importlib.import_module("libusb_package").get_library_path()
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
            return importlib.import_module("open3d")
    except ImportError as error:
        mend = install_line("eval")
        if ".so" in str(error):
            mend = "install that library (Debian, Ubuntu: apt install libx11-6 libgl1 libegl1 libudev1 libidn2-0)"
        raise MissingPackage(f"ICP and normals need Open3D ({error}): {mend}") from error
