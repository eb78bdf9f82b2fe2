"""Metrics and evaluation: depth, poses, trajectories, point clouds; baselines, runner, tables and plots."""

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
