"""From frames on disk to results on disk: sources, reconstructions, the viewer."""

from logvggt_jax.reconstruction.calibration import Calibration
from logvggt_jax.reconstruction.cameras_file import read_cameras, write_cameras
from logvggt_jax.reconstruction.depth_files import read_depth, write_depth
from logvggt_jax.reconstruction.exporters import EXPORTERS, export
from logvggt_jax.reconstruction.exporters.tum import read_trajectory, write_trajectory
from logvggt_jax.reconstruction.fusion.fuse import fuse
from logvggt_jax.reconstruction.fusion.rescale import rescale
from logvggt_jax.reconstruction.points.point_filter import PointFilter
from logvggt_jax.reconstruction.reconstruct import reconstruct
from logvggt_jax.reconstruction.result import Reconstruction
from logvggt_jax.reconstruction.sources import Source, SourceFrame, SourceOptions, open_source

__all__ = [
    "EXPORTERS",
    "Calibration",
    "PointFilter",
    "Reconstruction",
    "Source",
    "SourceFrame",
    "SourceOptions",
    "export",
    "fuse",
    "open_source",
    "read_cameras",
    "read_depth",
    "read_trajectory",
    "reconstruct",
    "rescale",
    "write_cameras",
    "write_depth",
    "write_trajectory",
]
