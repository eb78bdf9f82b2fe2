"""From frames on disk to results on disk: sources, reconstructions, the viewer."""

from logvggt_jax.reconstruction.depth_files import read_depth, write_depth
from logvggt_jax.reconstruction.point_cloud import PointFilter, write_point_cloud
from logvggt_jax.reconstruction.reconstruct import Reconstruction, reconstruct
from logvggt_jax.reconstruction.sources import FolderSource, SourceFrame, VideoSource, open_source
from logvggt_jax.reconstruction.trajectory_files import (
    read_cameras,
    read_trajectory,
    write_cameras,
    write_trajectory,
)

__all__ = [
    "FolderSource",
    "PointFilter",
    "Reconstruction",
    "SourceFrame",
    "VideoSource",
    "open_source",
    "read_cameras",
    "read_depth",
    "read_trajectory",
    "reconstruct",
    "write_cameras",
    "write_depth",
    "write_point_cloud",
    "write_trajectory",
]
