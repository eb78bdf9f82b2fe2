"""Relative poses of frame pairs: rotation and translation-direction errors, RRA, RTA and AUC.

Source: the CO3D protocol of VGGT (`evaluation/test_co3d.py`).
"""

import numpy as np

from logvggt_jax.geometry import as_matrix, rotation_angle
from logvggt_jax.metrics.errors import NotMeasurable

# Keeps directions of zero length and arccosines of one finite, as the reference does.
_EPSILON = 1e-15


def relative_pose_errors(
    predicted_extrinsics: np.ndarray, true_extrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all N(N-1)/2 relative poses T_i T_j^-1, i < j, in the order (0, 1), (0, 2), …

    Args:
      predicted_extrinsics: [N, 3, 4] or [N, 4, 4], world-to-camera (OpenCV); any world, any scale.
      true_extrinsics: the same for the ground truth.

    Returns:
      Rotation errors in degrees, [0, 180], and angles between the directions of translation in degrees, [0,
      90], since their sign is ignored; each [N(N-1)/2] float64. A pair without translation has 90 degrees.

    Raises:
      NotMeasurable: fewer than two frames, or a pose that is not finite (the frame is named).
      ValueError: lengths or shapes differ.
    """
    predicted = checked_poses(predicted_extrinsics, "predicted_extrinsics")
    true = checked_poses(true_extrinsics, "true_extrinsics")
    if len(predicted) != len(true):
        raise ValueError(f"relative_pose_errors: {len(predicted)} predicted poses, {len(true)} true ones")
    if len(true) < 2:
        raise NotMeasurable(f"relative_pose_errors: relative poses need at least 2 frames, got {len(true)}")
    rotations, translations = [], []
    # One frame against all later ones at a time: memory stays linear in the number of frames.
    for i in range(len(true) - 1):
        predicted_rotation, predicted_translation = _relative(predicted, i)
        true_rotation, true_translation = _relative(true, i)
        rotations.append(np.degrees(rotation_angle(predicted_rotation, true_rotation)))
        translations.append(_direction_error(predicted_translation, true_translation))
    return np.concatenate(rotations), np.concatenate(translations)


def pose_accuracy(rotation: np.ndarray, translation: np.ndarray, threshold: int = 30) -> dict[str, float]:
    """Fractions of pairs within `threshold` degrees, and the area under the curve up to it.

    Args:
      rotation: [P] rotation errors in degrees.
      translation: [P] translation-direction errors in degrees.
      threshold: whole degrees.

    Returns:
      `rra` and `rta`, the fractions of errors below the threshold; `auc`, the mean over 1, 2, … `threshold`
      of the fraction of pairs whose larger error is below (at the last bin: at most) that many degrees. AUC
      is at most min(RRA, RTA) unless errors lie exactly on the threshold.

    Raises:
      ValueError: no pairs, lengths that differ, NaN errors, a threshold that is not a positive whole number.
    """
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    if rotation.ndim != 1 or rotation.shape != translation.shape or not rotation.size:
        raise ValueError(
            f"pose_accuracy: need two error vectors of one length >= 1, got {rotation.shape} and {translation.shape}"
        )
    if np.isnan(rotation).any() or np.isnan(translation).any():
        raise ValueError("pose_accuracy: errors contain NaN; every pair must have a finite pose")
    if not threshold >= 1 or threshold % 1:  # NaN and infinity as well
        raise ValueError(f"pose_accuracy: threshold must be a positive whole number, got {threshold}")
    larger = np.maximum(rotation, translation)
    counts, _ = np.histogram(larger, bins=np.arange(int(threshold) + 1))
    return {
        "rra": float(np.mean(rotation < threshold)),
        "rta": float(np.mean(translation < threshold)),
        "auc": float(np.mean(np.cumsum(counts)) / larger.size),
    }


def checked_poses(poses: np.ndarray, name: str) -> np.ndarray:
    """Poses [N, 3|4, 4] as float64 [N, 4, 4]; ValueError for other shapes, NotMeasurable for one that is not finite."""
    poses = np.asarray(poses, np.float64)
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)):
        raise ValueError(f"{name} must have shape [N, 3, 4] or [N, 4, 4], got {poses.shape}")
    bad = np.flatnonzero(~np.isfinite(poses).all((1, 2)))
    if bad.size:
        raise NotMeasurable(f"{name}: the pose of frame {bad[0]} is not finite ({bad.size} such frames)")
    return as_matrix(poses)


def _relative(poses: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [N - i - 1, 3, 3] and translations [N - i - 1, 3] of T_i T_j^-1 for all j > i, from poses [N, 4, 4]."""
    rotation = poses[i, :3, :3] @ poses[i + 1 :, :3, :3].swapaxes(-1, -2)
    return rotation, poses[i, :3, 3] - np.einsum("jab,jb->ja", rotation, poses[i + 1 :, :3, 3])


def _direction_error(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Degrees [P] in [0, 90] between the lines along translations [P, 3]."""
    predicted = predicted / (np.linalg.norm(predicted, axis=-1, keepdims=True) + _EPSILON)
    true = true / (np.linalg.norm(true, axis=-1, keepdims=True) + _EPSILON)
    sine_squared = np.maximum(1.0 - (predicted * true).sum(-1) ** 2, _EPSILON)
    return np.degrees(np.arccos(np.sqrt(np.maximum(1.0 - sine_squared, 0.0))))
