"""The paper's benchmarks: protocols, methods as rows, costs, reports; measured with `logvggt_jax.metrics`."""

from logvggt_jax.metrics import (
    depth_metrics,
    point_cloud_metrics,
    pose_accuracy,
    relative_pose_errors,
    trajectory_errors,
)

__all__ = ["depth_metrics", "point_cloud_metrics", "pose_accuracy", "relative_pose_errors", "trajectory_errors"]
