"""Metrics and evaluation: depth, poses, trajectories, point clouds; the paper's benchmarks, runner, tables and plots.

Metrics work on numpy arrays and return fractions, not percent. Benchmarks are declared in `protocols`, run by `runner`
with rows from `methods` and `baselines`, and written by `report`; `paper_tables` puts them beside the paper's numbers.
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
