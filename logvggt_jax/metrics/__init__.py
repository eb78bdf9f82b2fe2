"""Error measures of depth, poses, trajectories and point clouds: one definition for validation and evaluation.

They work on numpy arrays and return fractions, not percent.
"""

from logvggt_jax.metrics.depth import depth_metrics
from logvggt_jax.metrics.errors import NotMeasurable
from logvggt_jax.metrics.points import point_cloud_metrics
from logvggt_jax.metrics.pose import pose_accuracy, relative_pose_errors
from logvggt_jax.metrics.trajectory import trajectory_errors

__all__ = [
    "NotMeasurable",
    "depth_metrics",
    "point_cloud_metrics",
    "pose_accuracy",
    "relative_pose_errors",
    "trajectory_errors",
]
