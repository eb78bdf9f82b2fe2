"""Metrics and evaluation: depth, poses, trajectories, point clouds; baselines, runner, tables and plots.

Metrics work on numpy arrays and return fractions, not percent. Running a model over a data set is in `runner`,
rows to compare with in `baselines`, tables in `report`, pictures in `plots`.
"""

from logvggt_jax.evaluation.depth import depth_metrics
from logvggt_jax.evaluation.points import point_cloud_metrics
from logvggt_jax.evaluation.pose import pose_accuracy, relative_pose_errors
from logvggt_jax.evaluation.trajectory import trajectory_errors

__all__ = [
    "depth_metrics",
    "point_cloud_metrics",
    "pose_accuracy",
    "relative_pose_errors",
    "trajectory_errors",
]
