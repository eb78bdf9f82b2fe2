"""Trajectories: absolute and relative errors after a similarity alignment of camera positions.

Source: the evaluation code of CUT3R (`eval/relpose/evo_utils.py`); errors and time association by evo.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from logvggt_jax.geometry import nearest_rotation, umeyama
from logvggt_jax.metrics.pose import checked_poses


def trajectory_errors(
    predicted_poses: np.ndarray,
    true_poses: np.ndarray,
    *,
    predicted_times: np.ndarray | None = None,
    true_times: np.ndarray | None = None,
) -> dict[str, float]:
    """Errors of a trajectory after the least-squares similarity that maps predicted onto true positions.

    Args:
      predicted_poses: [N, 3, 4] or [N, 4, 4], camera-to-world (OpenCV), any unit.
      true_poses: [M, 3, 4] or [M, 4, 4], camera-to-world.
      predicted_times: [N] seconds; with `true_times` [M], needed only where N and M differ: poses are then
        paired by the nearest time within 0.01 s. Trajectories of one length are paired by index whatever
        their times.
      true_times: see there.

    Returns:
      Root mean squares: `ate` of positions and `rpe_translation` of steps from frame to frame, both in the
      unit of `true_poses`; `rpe_rotation` of those steps in degrees.

    Raises:
      ValueError: no similarity exists (fewer than three poses, a static or a straight trajectory), a pose is
        not finite (the frame is named), lengths differ without times.
      ImportError: evo is not installed.
    """
    predicted = checked_poses(predicted_poses, "predicted_poses")
    true = checked_poses(true_poses, "true_poses")
    if len(predicted) != len(true):
        predicted, true = _paired(predicted, true, predicted_times, true_times)
    metrics = _evo("metrics")
    paths = (_path(true), _path(align_trajectory(predicted, true)))
    relation = metrics.PoseRelation
    absolute = metrics.APE(relation.translation_part)
    absolute.process_data(paths)
    errors = {"ate": absolute}
    for name, part in (
        ("rpe_translation", relation.translation_part),
        ("rpe_rotation", relation.rotation_angle_deg),
    ):
        relative = metrics.RPE(part, delta=1, all_pairs=True)
        relative.process_data(paths)
        errors[name] = relative
    return {name: float(error.get_statistic(metrics.StatisticsType.rmse)) for name, error in errors.items()}


def align_trajectory(predicted_poses: np.ndarray, true_poses: np.ndarray) -> np.ndarray:
    """Camera-to-world poses [N, 4, 4] carried into the world and the unit of the true ones.

    Raises ValueError where positions admit no unique similarity.
    """
    predicted = checked_poses(predicted_poses, "predicted_poses")
    true = checked_poses(true_poses, "true_poses")
    try:
        similarity = umeyama(predicted[:, :3, 3], true[:, :3, 3])
    except ValueError as error:
        raise ValueError(
            f"trajectory of {len(true)} poses cannot be aligned ({error}); it must neither stand still nor be straight"
        ) from error
    aligned = predicted.copy()
    aligned[:, :3, :3] = similarity.rotation @ predicted[:, :3, :3]
    aligned[:, :3, 3] = similarity.apply(predicted[:, :3, 3])
    return aligned


def rms_radius(positions: np.ndarray) -> float:
    """Root mean square distance of positions [N, 3] from their mean: the ATE of a camera that never moves."""
    centred = np.asarray(positions, np.float64) - np.mean(positions, axis=0)
    return float(np.sqrt((centred**2).sum(-1).mean()))


def _paired(
    predicted: np.ndarray, true: np.ndarray, predicted_times: np.ndarray | None, true_times: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    if predicted_times is None or true_times is None:
        raise ValueError(
            f"trajectory_errors: {len(predicted)} predicted and {len(true)} true poses; "
            "give predicted_times and true_times to pair them"
        )
    for name, times, poses in (("predicted", predicted_times, predicted), ("true", true_times, true)):
        if np.shape(times) != (len(poses),):
            raise ValueError(f"trajectory_errors: {name}_times needs shape ({len(poses)},), got {np.shape(times)}")
    trajectory = _evo("trajectory").PoseTrajectory3D
    try:
        matched_true, matched_predicted = _evo("sync").associate_trajectories(
            trajectory(poses_se3=list(true), timestamps=np.asarray(true_times, np.float64)),
            trajectory(poses_se3=list(predicted), timestamps=np.asarray(predicted_times, np.float64)),
            max_diff=0.01,
        )
    except _evo("sync").SyncException as error:
        raise ValueError(f"trajectory_errors: no predicted time lies within 0.01 s of a true one ({error})") from error
    return np.stack(matched_predicted.poses_se3), np.stack(matched_true.poses_se3)


def _path(poses: np.ndarray) -> Any:
    # evo refuses float32 rotations whose products drift off SO(3) by more than 1e-6.
    poses = poses.copy()
    poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
    return _evo("trajectory").PosePath3D(poses_se3=list(poses))


def _evo(module: str) -> Any:
    import importlib

    try:
        return importlib.import_module(f"evo.core.{module}")
    except ImportError as error:
        raise ImportError(f'trajectory errors need evo ({error}): pip install "logvggt-jax[eval]"') from error
