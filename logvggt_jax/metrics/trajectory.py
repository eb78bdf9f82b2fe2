"""Trajectories: absolute and relative errors after a similarity alignment of camera positions.

Source: the evaluation code of CUT3R (`eval/relpose/evo_utils.py`); errors by evo.
"""

from typing import Any

import numpy as np

from logvggt_jax.errors import MissingPackage, install_line
from logvggt_jax.geometry import NoSimilarity, nearest_rotation, umeyama
from logvggt_jax.metrics.errors import NotMeasurable
from logvggt_jax.metrics.pose import checked_poses


def trajectory_errors(predicted_poses: np.ndarray, true_poses: np.ndarray) -> dict[str, float]:
    """Errors of a trajectory after the least-squares similarity that maps predicted onto true positions.

    Args:
      predicted_poses: [N, 3, 4] or [N, 4, 4], camera-to-world (OpenCV), any unit.
      true_poses: [N, 3, 4] or [N, 4, 4], camera-to-world, of the same frames.

    Returns:
      Root mean squares: `ate` of positions and `rpe_translation` of steps from frame to frame, both in the
      unit of `true_poses`; `rpe_rotation` of those steps in degrees.

    Raises:
      NotMeasurable: no similarity exists (fewer than three poses, a static or a straight trajectory), or a pose is
        not finite (the frame is named). It is a ValueError.
      ValueError: lengths or shapes differ.
      MissingPackage: evo is not installed.
    """
    predicted = checked_poses(predicted_poses, "predicted_poses")
    true = checked_poses(true_poses, "true_poses")
    metrics = _evo("metrics")
    paths = (_path(true), _path(align_trajectory(predicted, true)))
    relation = metrics.PoseRelation
    absolute = metrics.APE(relation.translation_part)
    absolute.process_data(paths)
    errors = {"ate": absolute}
    for name, part in (("rpe_translation", relation.translation_part), ("rpe_rotation", relation.rotation_angle_deg)):
        relative = metrics.RPE(part, delta=1, all_pairs=True)
        relative.process_data(paths)
        errors[name] = relative
    return {name: float(error.get_statistic(metrics.StatisticsType.rmse)) for name, error in errors.items()}


def align_trajectory(predicted_poses: np.ndarray, true_poses: np.ndarray) -> np.ndarray:
    """Camera-to-world poses [N, 4, 4] carried into the world and the unit of the true ones.

    Raises NotMeasurable where positions admit no unique similarity or a pose is not finite, ValueError where lengths or
    shapes differ.
    """
    predicted = checked_poses(predicted_poses, "predicted_poses")
    true = checked_poses(true_poses, "true_poses")
    if len(predicted) != len(true):
        raise ValueError(f"{len(predicted)} predicted and {len(true)} true poses: give one of each a frame")
    try:
        similarity = umeyama(predicted[:, :3, 3], true[:, :3, 3])
    except NoSimilarity as error:
        raise NotMeasurable(
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
        raise MissingPackage(f"trajectory errors need evo ({error}): {install_line('eval')}") from error
